"""Covariances of poses and sensors from a solved graph."""

from collections.abc import Iterator
from contextlib import contextmanager

import gtsam
import numpy as np

from l2m_factors import D, G, T, X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.slam_results import OdometryScale

TOGETHER = 200  # poses: the covariance of so many is 11 MB


@contextmanager
def well_scaled() -> Iterator[None]:
    """Say in one line why GTSAM cannot solve what is done inside.

    Raises
    ------
    CalibrationError
        GTSAM's Cholesky cannot factor it. Every variable has a prior or hangs on one, so that this
        is a matter of scale.
    """
    try:
        yield
    except RuntimeError as error:  # GTSAM's IndeterminantLinearSystemException has no Python type
        if "ndetermina" not in str(error):
            raise
        raise CalibrationError(
            "the covariances of the poses cannot be computed: those of odometry, start and "
            "calibration are too many orders of magnitude apart"
        ) from error


def solved_marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Marginals:
    """Return the marginals of a solved graph; see ``well_scaled``."""
    with well_scaled():
        return gtsam.Marginals(graph, values)


def pose_covariances(marginals: gtsam.Marginals, count: int) -> FloatArray:
    """Return those of right perturbations of so many key poses, shape (K, 6, 6).

    One by one, along the elimination tree, each at the same cost however long the drive is.
    """
    return np.stack([marginals.marginalCovariance(X(k)) for k in range(count)])


def pose_covariances_together(marginals: gtsam.Marginals, count: int) -> FloatArray:
    """Return the same by eliminating all the rest, once for many poses.

    For graphs in which each way through the elimination tree leads through nearly all of it:
    without a map, with tiles that share refined calibrations, 0.7 s instead of 27 s for 115 poses.
    """
    blocks: list[FloatArray] = []
    for first in range(0, count, TOGETHER):
        keys = [X(k) for k in range(first, min(first + TOGETHER, count))]
        joint = marginals.jointMarginalCovariance(keys)
        blocks.extend(joint.at(key, key) for key in keys)
    return np.stack(blocks)


def odometry_scale(marginals: gtsam.Marginals, values: gtsam.Values) -> OdometryScale | None:
    """Return odometry's scale as it came out; None where it is no variable."""
    if not values.exists(G()):
        return None
    variance = float(marginals.marginalCovariance(G())[0, 0])
    return OdometryScale(values.atDouble(G()), float(np.sqrt(variance)))


def sensor_covariances(marginals: gtsam.Marginals, count: int) -> FloatArray:
    """Return those of (t, C row by row, H) of so many sensors in m and uT, shape (S, 15, 15)."""
    blocks = []
    for i in range(count):
        keys = [T(i), D(i)]
        joint = marginals.jointMarginalCovariance(keys)
        blocks.append(np.block([[joint.at(a, b) for b in keys] for a in keys]))
    return np.stack(blocks)
