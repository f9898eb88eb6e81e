"""Covariances of what the graphs of SLAM determine."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from l2m_factors import D, G, T, X
from l2m_gtsam.calibration.joint_information import columns_at, slices_of
from l2m_gtsam.calibration.optimise import refused
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.localisation import OdometryScale
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.solve.linear_algebra import triangular_information_root

TOGETHER = 200  # poses: the covariance of so many is 11 MB
Result = TypeVar("Result")


@contextmanager
def reported_ill_conditioning() -> Iterator[None]:
    """Raise a CalibrationError in one line where GTSAM cannot factor what is done inside.

    Raises
    ------
    CalibrationError
        A system is indeterminate. A prior determines every variable at least indirectly, so that
        the cause is bad scaling.
    """
    try:
        yield
    except (RuntimeError, np.linalg.LinAlgError) as error:
        if isinstance(error, RuntimeError) and not refused(error):
            raise
        raise CalibrationError(
            "the covariances of the poses cannot be computed: those of odometry, start and "
            "calibration are too many orders of magnitude apart"
        ) from error


class PoseCovariance(Protocol):
    """The joint covariance of a drive's poses."""

    def variance_along(self, directions: Mapping[int, FloatArray], /) -> float:
        """Return ``d^T P d`` for a direction d in which poses move together."""


class Marginals:
    """Covariances of a linear graph's variables, by Cholesky, or by QR where that fails.

    GTSAM's Cholesky fails on directions 4,000 times weaker than others; QR does not.

    Parameters
    ----------
    linear
        The graph, linearised at its solution.
    ordering
        Elimination order of its variables.
    """

    def __init__(self, linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> None:
        self._linear, self._ordering = linear, ordering

    def of(self, key: int) -> FloatArray:
        """Return the covariance of one variable."""
        tree = self._cholesky
        covariance = (
            None if tree is None else unless_indeterminate(lambda: tree.marginalCovariance(key))
        )
        if covariance is None:
            covariance = covariance_of(
                self._qr.marginalFactor(key, gtsam.EliminateQR).jacobian()[0]
            )
        return covariance

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Return the joint covariance of some variables, in this order."""
        tree, own = self._cholesky, list(keys)
        if tree is not None:
            covariance = unless_indeterminate(
                lambda: tree.jointMarginalCovariance(own).fullMatrix()
            )
            if covariance is not None:
                return np.asarray(covariance)
        left = self._qr.joint(own, gtsam.EliminateQR)
        return net_covariance(left.eliminateSequential(ordered(keys), gtsam.EliminateQR), keys)

    def variance_along(self, directions: Mapping[int, FloatArray]) -> float:
        """Return ``d^T P d`` for a direction d in which variables move together.

        Parameters
        ----------
        directions
            Its part of each variable, shapes (6,) for poses.
        """
        # P d is where the minimum goes if the cost is less by d times the variables.
        pulled = gtsam.GaussianFactorGraph()
        pulled.push_back(self._linear)
        for key, own in directions.items():
            pulled.add(gtsam.HessianFactor(key, np.zeros((len(own), len(own))), own, 0.0))
        tree = self._cholesky
        after = unless_indeterminate(lambda: pulled.optimize(self._ordering))
        if tree is None or after is None:  # errors that go together are the largest
            sigma = (np.sqrt(own @ self.of(key) @ own) for key, own in directions.items())
            return float(sum(sigma)) ** 2
        before = tree.optimize()
        return float(sum(own @ (after.at(key) - before.at(key)) for key, own in directions.items()))

    def log_determinant(self, without: Sequence[int] = ()) -> float:
        """Return half of the logarithm of the determinant of the information.

        Parameters
        ----------
        without
            Variables that are integrated out; each has a prior.
        """
        tree = self._qr if self._cholesky is None else self._cholesky
        whole = float(tree.logDeterminant())
        if not without:
            return whole
        # The conditionals of what is eliminated first are its information where the rest is known.
        first, _ = self._linear.eliminatePartialMultifrontal(ordered(without))
        return whole - float(first.logDeterminant())

    @cached_property
    def _cholesky(self) -> gtsam.GaussianBayesTree | None:
        return unless_indeterminate(lambda: self._linear.eliminateMultifrontal(self._ordering))

    @cached_property
    def _qr(self) -> gtsam.GaussianBayesTree:
        return self._linear.eliminateMultifrontal(self._ordering, gtsam.EliminateQR)


@dataclass(frozen=True)
class JointPosterior:
    """What a linear graph says of some of its variables.

    Attributes
    ----------
    covariance
        Joint, shape (n, n).
    mean
        From where the graph was linearised, shape (n,).
    decrease
        Of the error from zero to the solution: what a step of Gauss and Newton promises.
    """

    covariance: FloatArray
    mean: FloatArray
    decrease: float


def joint_posterior(linear: gtsam.GaussianFactorGraph, keys: Sequence[int]) -> JointPosterior:
    """Return the joint posterior of some variables, in this order, by eliminating the others.

    For a single query: 0.03 s for one pose of a section, where a tree of all takes 0.11 s. What is
    left is dense. GTSAM decides whether Cholesky solves it, and LAPACK inverts it: 55 ms in all for
    270 components, where GTSAM's covariance of its tree takes 77.
    """
    last = ordered(keys)

    def by_cholesky() -> tuple[FloatArray, FloatArray, float]:
        left = linear.marginal(list(keys))
        left.eliminateMultifrontal(last)
        augmented = left.augmentedHessian(last)
        W = triangular_information_root(augmented[:-1, :-1], 0.0)
        # Its constant is twice the error at the solution for the others, and these at zero.
        white = W @ augmented[:-1, -1]
        least = float(0.5 * (augmented[-1, -1] - white @ white))
        return np.asarray(W.T @ W), np.asarray(W.T @ white), least

    def by_qr() -> tuple[FloatArray, FloatArray, float]:
        net = linear.marginalMultifrontalBayesNet(last, gtsam.EliminateQR)
        best = linear.optimize(gtsam.EliminateQR)
        mean = np.concatenate([best.at(key) for key in keys])
        return net_covariance(net, keys), mean, linear.error(best)

    covariance, mean, least = unless_indeterminate(by_cholesky) or by_qr()
    here = linear.error(gtsam.VectorValues.Zero(linear.gradientAtZero()))
    return JointPosterior(covariance, mean, here - least)


def ordered(keys: Sequence[int]) -> gtsam.Ordering:
    """Return keys as an elimination order."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def unless_indeterminate(work: Callable[[], Result]) -> Result | None:
    """Return what GTSAM computes; None where a linear system is indeterminate to it."""
    try:
        return work()
    except (RuntimeError, ValueError) as error:
        if not refused(error):
            raise
        return None


def net_covariance(net: gtsam.GaussianBayesNet, keys: Sequence[int]) -> FloatArray:
    """Return the joint covariance of a net's variables, each eliminated by itself, in this order.

    GTSAM eliminates along a tree: the variables of another branch may come first, whatever the
    ordering says.
    """
    parts = [net.at(row) for row in range(net.size())]
    slices = slices_of({each.firstFrontalKey(): len(each.R()) for each in parts})
    at = columns_at(slices, keys)
    return covariance_of(net.matrix()[0])[np.ix_(at, at)]


def covariance_of(root: FloatArray) -> FloatArray:
    """Return ``(R^T R)^-1`` of an upper triangle R.

    GTSAM would invert ``R^T R`` by Cholesky, which squares the condition number again.
    """
    half, singular = dtrtri(root)
    if singular:
        raise np.linalg.LinAlgError("no factor determines a variable")
    return np.asarray(half @ half.T)


def pose_covariances(marginals: Marginals, count: int) -> FloatArray:
    """Return covariances of the first ``count`` key poses, shape (K, 6, 6).

    One by one along the elimination tree, at a cost that does not grow with the drive. Of right
    perturbations, rotation (rad) before translation (m).
    """
    with reported_ill_conditioning():
        return np.stack([marginals.of(X(k)) for k in range(count)])


def pose_covariances_together(marginals: Marginals, count: int) -> FloatArray:
    """Return the same from joint covariances of many poses.

    For graphs in which each path to the root of the elimination tree contains nearly all of it:
    without a map 0.1 s instead of 3 s for 116 poses, with calibrations that are refined.
    """
    blocks: list[FloatArray] = []
    for first in range(0, count, TOGETHER):
        keys = [X(k) for k in range(first, min(first + TOGETHER, count))]
        with reported_ill_conditioning():
            joint = marginals.joint(keys).reshape(len(keys), POSE, len(keys), POSE)
        blocks.extend(np.einsum("kikj->kij", joint))
    return np.stack(blocks)


def jump_covariances(marginals: Marginals, drive: Drive) -> FloatArray:
    """Return joint covariances of the poses before and after odometry's jumps, (J, 12, 12)."""
    with reported_ill_conditioning():
        joint = [marginals.joint([X(each.step), X(each.step + 1)]) for each in drive.jumps]
    return np.reshape(joint, (-1, 2 * POSE, 2 * POSE))


def odometry_scale(marginals: Marginals, values: gtsam.Values) -> OdometryScale | None:
    """Return the estimate of odometry's scale; None where it is no variable."""
    if not values.exists(G()):
        return None
    with reported_ill_conditioning():
        variance = float(marginals.of(G())[0, 0])
    return OdometryScale(values.atDouble(G()), float(np.sqrt(variance)))


def sensor_covariances(
    marginals: Marginals, values: gtsam.Values, known: KnownSensors
) -> FloatArray:
    """Return covariances of (t, C row by row, H) of the sensors in m and uT, shape (S, 15, 15).

    The known ones where calibrations are no variables.
    """
    if not values.exists(T(0)):
        return known.covariance
    with reported_ill_conditioning():
        return np.stack([marginals.joint([T(i), D(i)]) for i in range(len(known.names))])
