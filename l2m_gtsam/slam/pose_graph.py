"""Odometry and what scans say: the poses of a drive before any magnetic reading is looked at.

A scan may be registered in a place that only looks like the right one. Which links are believed is
found by graduated non-convexity on the whole pose graph (GTSAM's ``GncLMOptimizer``; H. Yang,
P. Antonante, V. Tzoumas, L. Carlone, 2020), with start and odometry taken for true.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_factors import X
from l2m_gtsam.data import BoolArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.factors import link_graph, odometry_graph
from l2m_gtsam.slam.map_prediction import poses_in

HALF = 0.5  # a link that weighs more is believed; in the end weights are nearly 0 or 1


@dataclass(frozen=True)
class PoseGraph:
    """A drive by odometry and scans.

    Attributes
    ----------
    poses
        Key poses, K of them.
    believed
        Which links are, shape (L,).
    """

    poses: list[gtsam.Pose3]
    believed: BoolArray


def solve_pose_graph(drive: Drive, confidence: float) -> PoseGraph:
    """Find key poses by odometry and links, and which links fit.

    Parameters
    ----------
    drive
        The drive; its readings take no part.
    confidence
        Of links with nothing but the errors that they state so many are believed.
    """
    poses = drive.dead_reckoning()
    if not len(drive.links):
        return PoseGraph(poses, np.empty(0, dtype=np.bool_))
    graph = odometry_graph(drive)
    sure = graph.size()
    graph.push_back(link_graph(drive.links))
    optimizer = gtsam.GncLMOptimizer(graph, _values(poses), _params(sure))
    optimizer.setInlierCostThresholdsAtProbability(confidence)
    found = poses_in(optimizer.optimize(), len(poses))
    believed = np.asarray(optimizer.getWeights())[sure:] > HALF
    return PoseGraph(list(found.values()), believed)


def _params(sure: int) -> gtsam.GncLMParams:
    """Return settings with which so many first factors are taken for true."""
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(sure)))
    return params


def _values(poses: list[gtsam.Pose3]) -> gtsam.Values:
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    return values
