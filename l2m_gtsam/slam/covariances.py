"""Covariances of poses and sensors from a solved graph."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TypeVar

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from l2m_factors import D, G, T, X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.localisation import OdometryScale
from l2m_gtsam.slam.online.belief import POSE

TOGETHER = 200  # poses: the covariance of so many is 11 MB

Found = TypeVar("Found")


@contextmanager
def well_scaled() -> Iterator[None]:
    """Say in one line why GTSAM cannot solve what is done inside.

    Raises
    ------
    CalibrationError
        GTSAM cannot factor it. Every variable has a prior or hangs on one, so that this is a matter
        of scale.
    """
    try:
        yield
    except (RuntimeError, np.linalg.LinAlgError) as error:
        if isinstance(error, RuntimeError) and not is_refused(error):
            raise
        raise CalibrationError(
            "the covariances of the poses cannot be computed: those of odometry, start and "
            "calibration are too many orders of magnitude apart"
        ) from error


def is_refused(error: RuntimeError) -> bool:
    """Return whether GTSAM could not factor a linear system: its exception has no Python type."""
    return "ndetermina" in str(error)


class Marginals:
    """Covariances of a linear graph's variables, by Cholesky, and by QR where that is refused.

    GTSAM's Cholesky gives up on directions 4,000 times weaker than others; QR does not mind.

    Parameters
    ----------
    linear
        The graph, linearised where it was solved.
    ordering
        In which its variables are eliminated.
    """

    def __init__(self, linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> None:
        self._linear, self._ordering = linear, ordering

    def of(self, key: int) -> FloatArray:
        """Return that of a variable by itself."""
        tree = self._cholesky
        found = None if tree is None else unless_refused(lambda: tree.marginalCovariance(key))
        if found is None:
            found = covariance_of(self._qr.marginalFactor(key, gtsam.EliminateQR).jacobian()[0])
        return found

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Return that of some variables, in this order."""
        tree, own = self._cholesky, list(keys)
        if tree is not None:
            found = unless_refused(lambda: tree.jointMarginalCovariance(own).fullMatrix())
            if found is not None:
                return np.asarray(found)
        left = self._qr.joint(own, gtsam.EliminateQR)
        net = left.eliminateSequential(ordered(keys), gtsam.EliminateQR)
        return covariance_of(net.matrix()[0])

    @cached_property
    def _cholesky(self) -> gtsam.GaussianBayesTree | None:
        return unless_refused(lambda: self._linear.eliminateMultifrontal(self._ordering))

    @cached_property
    def _qr(self) -> gtsam.GaussianBayesTree:
        return self._linear.eliminateMultifrontal(self._ordering, gtsam.EliminateQR)


def joint_covariance(linear: gtsam.GaussianFactorGraph, keys: Sequence[int]) -> FloatArray:
    """Return that of some variables, in this order, by eliminating the rest for them alone.

    For who asks once: of one pose of a section 0.03 s, where a tree of all takes 0.11 s.
    """
    own, last = list(keys), ordered(keys)

    def by_cholesky() -> FloatArray:
        tree = linear.marginal(own).eliminateMultifrontal(last)
        return np.asarray(tree.jointMarginalCovariance(own).fullMatrix())

    found = unless_refused(by_cholesky)
    if found is None:
        net = linear.marginalMultifrontalBayesNet(last, gtsam.EliminateQR)
        found = covariance_of(net.matrix()[0])
    return found


def ordered(keys: Sequence[int]) -> gtsam.Ordering:
    """Return keys as an order of elimination."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def unless_refused(work: Callable[[], Found]) -> Found | None:
    """Return what GTSAM computes; none where it cannot factor a linear system."""
    try:
        return work()
    except RuntimeError as error:
        if not is_refused(error):
            raise
        return None


def covariance_of(root: FloatArray) -> FloatArray:
    """Return ``(R^T R)^-1`` of an upper triangle R.

    GTSAM would invert ``R^T R`` by Cholesky: what QR has gained would be lost.
    """
    half = solve_triangular(root, np.eye(len(root)))
    return np.asarray(half @ half.T)


def pose_covariances(marginals: Marginals, count: int) -> FloatArray:
    """Return those of right perturbations of so many key poses, shape (K, 6, 6).

    One by one, along the elimination tree, each at the same cost however long the drive is.
    """
    with well_scaled():
        return np.stack([marginals.of(X(k)) for k in range(count)])


def pose_covariances_together(marginals: Marginals, count: int) -> FloatArray:
    """Return the same from joint covariances of many poses.

    For graphs in which each way through the elimination tree leads through nearly all of it:
    without a map 0.1 s instead of 3 s for 116 poses, with calibrations that are refined.
    """
    blocks: list[FloatArray] = []
    for first in range(0, count, TOGETHER):
        keys = [X(k) for k in range(first, min(first + TOGETHER, count))]
        with well_scaled():
            joint = marginals.joint(keys).reshape(len(keys), POSE, len(keys), POSE)
        blocks.extend(np.einsum("kikj->kij", joint))
    return np.stack(blocks)


def odometry_scale(marginals: Marginals, values: gtsam.Values) -> OdometryScale | None:
    """Return odometry's scale as it came out; None where it is no variable."""
    if not values.exists(G()):
        return None
    with well_scaled():
        variance = float(marginals.of(G())[0, 0])
    return OdometryScale(values.atDouble(G()), float(np.sqrt(variance)))


def sensor_covariances(marginals: Marginals, count: int) -> FloatArray:
    """Return those of (t, C row by row, H) of so many sensors in m and uT, shape (S, 15, 15)."""
    with well_scaled():
        return np.stack([marginals.joint([T(i), D(i)]) for i in range(count)])
