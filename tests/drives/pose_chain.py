"""Chains of poses whose covariances are known in closed form."""

import gtsam
import numpy as np

from l2m_factors import X
from l2m_gtsam.data import FloatArray

# Of a start and of steps, rotation (rad) before translation (m).
FAR_APART = [
    ([1e-9, 1e-9, 1e-9, 1e3, 1e3, 1e3], [1e-2] * 6),
    ([1e-2, 1e-2, 1e-2, 1.0, 1.0, 1e4], [1e-3] * 6),
    ([1e-2, 1e-2, 1e-2, 1.0, 1.0, 1.0], [1e-2] * 5 + [1e5]),
]


def chain(
    start: list[float], step: list[float]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[FloatArray]]:
    """Return poses with these sigmas, and their covariances."""
    rng, graph, values = np.random.default_rng(1), gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas, pose = gtsam.noiseModel.Diagonal.Sigmas, gtsam.Pose3()
    graph.add(gtsam.PriorFactorPose3(X(0), pose, sigmas(np.array(start))))
    values.insert(X(0), pose)
    P = [np.diag(np.square(start))]
    for k in range(8):
        move = gtsam.Pose3.Expmap(rng.normal(0, 0.2, 6))
        graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), move, sigmas(np.array(step))))
        pose = pose.compose(move)
        values.insert(X(k + 1), pose)
        Ad = move.inverse().AdjointMap()
        P.append(Ad @ P[-1] @ Ad.T + np.diag(np.square(step)))
    return graph, values, P


def off(found: FloatArray, P: FloatArray) -> float:
    """Return how far a covariance is off, in units of the sigmas."""
    sigma = np.sqrt(np.diag(P))
    return float(np.abs((found - P) / np.outer(sigma, sigma)).max())
