"""What loop closures without errors leave of a drift: a reference that needs the true poses.

Wherever the true path comes near itself the two key poses are linked as they truly are. Odometry
between such places drifts on, so that this is what a method that recognises places can come to
whose reach is that distance.
"""

from dataclasses import replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.optimise import TOLERANCE
from l2m_gtsam.data import Trajectory
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.pose_graph import drive_graph, drive_values
from l2m_gtsam.slam.solver import colamd_ordering, levenberg_marquardt

SURE = 1e-3  # metres and rad of a loop: far below every drift
AWAY_M = 3.0  # path to an earlier key pose: nearer ones are neighbours, no loop
ITERATIONS = 50


def closed_by_exact_loops(drive: Drive, truth: Trajectory, within_m: float) -> list[gtsam.Pose3]:
    """Return the key poses of a drive by odometry and loops without errors.

    Parameters
    ----------
    drive
        K key poses with odometry.
    truth
        The true poses at these.
    within_m
        Two key poses are a loop where they are so near to each other, metres.
    """
    linked = replace(drive, links=exact_loops(drive, truth, within_m))
    graph, initial = drive_graph(linked), drive_values(linked, drive.dead_reckoning())
    order = colamd_ordering(graph)
    found = levenberg_marquardt(graph, initial, order, ITERATIONS, TOLERANCE)
    return poses_in(found.values, len(drive))


def exact_loops(drive: Drive, truth: Trajectory, within_m: float) -> Links:
    """Return true relative poses of key poses that come near earlier ones; arguments as above."""
    path = drive.steps.path
    away = path[:, None] - path >= max(AWAY_M, 2 * within_m)
    near = np.linalg.norm(truth.p[:, None] - truth.p, axis=2) <= within_m
    later, earlier = np.nonzero(away & near)
    back = truth.R[earlier].transpose(0, 2, 1)
    R, p = back @ truth.R[later], np.einsum("lij,lj->li", back, truth.p[later] - truth.p[earlier])
    covariance = np.tile(SURE**2 * np.eye(6), (len(later), 1, 1))
    return Links(earlier, later, R, p, covariance)
