"""Covariances of many poses: one by one, and by eliminating the rest."""

import gtsam
import numpy as np

from l2m_factors import T, X
from l2m_gtsam.graph.slam.covariances import (
    TOGETHER,
    pose_covariances,
    pose_covariances_together,
    solved_marginals,
)

COUNT = TOGETHER + 30  # poses: more than are eliminated for at once


def test_poses_together_are_as_sure_as_one_by_one() -> None:
    """A chain of poses that all see one landmark, of which they know little."""
    rng, graph, values = np.random.default_rng(3), gtsam.NonlinearFactorGraph(), gtsam.Values()
    step = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.02, 0.05, 0.05, 0.03]))
    pose = gtsam.Pose3()
    graph.add(gtsam.PriorFactorPose3(X(0), pose, step))
    graph.add(gtsam.PriorFactorPoint3(T(0), np.ones(3), gtsam.noiseModel.Isotropic.Sigma(3, 2.0)))
    values.insert(T(0), np.ones(3))
    for k in range(COUNT):
        values.insert(X(k), pose)
        away = np.linalg.norm(pose.transformTo(np.ones(3)))
        seen = gtsam.noiseModel.Isotropic.Sigma(1, 0.02)
        graph.add(gtsam.RangeFactor3D(X(k), T(0), away, seen))
        move = gtsam.Pose3.Expmap(rng.normal(0, 0.2, 6))
        if k + 1 < COUNT:
            graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), move, step))
        pose = pose.compose(move)
    marginals = solved_marginals(graph, values)
    alone = pose_covariances(marginals, COUNT)
    together = pose_covariances_together(marginals, COUNT)
    np.testing.assert_allclose(together, alone, rtol=1e-7, atol=1e-9 * alone.max())
