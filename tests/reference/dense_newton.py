"""The slow reference of SLAM's solver: Newton steps of a dense system, as Gauss has it."""

from collections.abc import Mapping

import gtsam
import numpy as np

from l2m_gtsam.calibration.joint_information import columns_at, slices_of
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.joint_gaussian import (
    JointGaussian,
    local,
    poses_among,
    retracted,
)

STEPS = 30


def newton(
    graph: gtsam.NonlinearFactorGraph,
    known: JointGaussian,
    values: gtsam.Values,
    sizes: Mapping[int, int],
    steps: int = STEPS,
) -> tuple[gtsam.Values, FloatArray]:
    """Return where a graph and a prior have their least cost, and the covariance there."""
    count, at = sum(sizes.values()), slices_of(sizes)
    among = [key for key in sizes if graph.keys().count(key)]
    own, prior = columns_at(at, among), columns_at(at, known.sizes)
    for _ in range(steps):
        H, descent = np.zeros((count, count)), np.zeros(count)
        H[np.ix_(own, own)], descent[own] = graph.linearize(values).hessian(gtsam.Ordering(among))
        information, gradient = _quadratic(known, values)
        H[np.ix_(prior, prior)] += information
        descent[prior] -= gradient
        values = retracted(values, sizes, np.asarray(np.linalg.solve(H, descent)))
    return values, np.asarray(np.linalg.inv(H))


def _quadratic(known: JointGaussian, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
    """Return second derivative and gradient of the prior by perturbations of values."""
    away, turn = local(known.values, values, known.sizes), np.eye(len(known.covariance))
    for own in poses_among(known.sizes):
        turn[own, own] = gtsam.Pose3.LogmapDerivative(away[own])
    J = np.linalg.solve(known.covariance, turn)
    return turn.T @ J, J.T @ away
