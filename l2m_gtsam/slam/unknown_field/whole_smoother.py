"""Batch SLAM of one sensor in an unknown field: poses and one field for the whole drive.

A Kalman filter follows the drive (:mod:`.forward_pass`), the field's covariance is learnt at its
poses, it follows once more, and from there Levenberg-Marquardt solves poses, field and the
distortion together.

The distortion is a variable even where the calibration is fixed: what steel on the vehicle adds is
the same at all headings, and without a map nothing else than tilts and headings of the poses could
take it up.
"""

from dataclasses import replace

import gtsam
import numpy as np

from l2m_factors import X
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import odometry_graph, scale_values
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.solver import Marginals, colamd_ordering, pose_covariances, weights_last
from l2m_gtsam.slam.unknown_field.forward_pass import filtered_poses
from l2m_gtsam.slam.unknown_field.tiled_smoother import AWAY_M, FieldSolution, TiledProblem
from l2m_gtsam.slam.unknown_field.whole_field import whole_prior

CONVEX = 1.0  # of the loss, with weights at the poses of the filter


def map_whole_drive(
    drive: Drive, initial: list[gtsam.Pose3], options: SlamOptions, progress: Progress
) -> FieldSolution | None:
    """Estimate the poses of a drive and one field along it.

    Parameters
    ----------
    drive
        The drive.
    initial
        K key poses by odometry.
    options
        How to solve.
    progress
        Called with a stage and the fraction of it that is done.

    Returns
    -------
    The poses; those of odometry where the readings are no less likely at them. None where the field
    has more detail than one basis holds.
    """
    whole, largest = options.whole_field, options.robust.largest
    free = replace(drive, sensors=drive.sensors.loosened(whole.distortion, whole.offset))
    scaled = free.with_scale_as_drift(options.drift.over_m)
    prior = whole_prior(free, initial, whole, options.tiles.learn_over_m)
    if prior is None:
        return None
    progress("following the drive", 0.0)
    poses = filtered_poses(scaled, prior.field, initial[0], largest)
    prior = whole_prior(free, poses, whole)
    if prior is None:
        return None
    progress("following the drive", 0.5)
    poses = filtered_poses(scaled, prior.field, initial[0], largest)
    progress("solving poses and field", 0.0)
    refined = options.model_copy(update={"calibration": CalibrationUse.REFINED})
    problem = TiledProblem(free, prior.divided, refined, weights_last)
    found = problem.finished(problem.solved(poses, free.sensors, 1.0, CONVEX))
    progress("solving poses and field", 1.0)
    solution = found.solution
    if options.calibration is CalibrationUse.FIXED:
        solution = replace(
            solution,
            drive=replace(solution.drive, sensors=drive.sensors),
            calibration_covariance=drive.sensors.covariance,
        )
    p = np.stack([pose.translation() for pose in solution.poses])
    found = replace(
        found,
        solution=solution,
        returns=returned(p, drive.steps.path, prior.spectrum.prior.length),
    )
    with_odometry = whole_prior(free, initial, whole)
    at_poses = whole_prior(free, solution.poses, whole)
    if with_odometry is None or at_poses is None:
        return found
    bent = 0.5 * solution.odometry_chi2 * 6 * len(drive)
    gained = at_poses.spectrum.log_likelihood - with_odometry.spectrum.log_likelihood - bent
    return found if gained > 0 else replace(found, solution=unchanged(drive, found), gained=False)


def unchanged(drive: Drive, found: FieldSolution) -> DriveSolution:
    """Return a solution with the poses and covariances of odometry alone."""
    values = scale_values(drive)
    for k, pose in enumerate(drive.dead_reckoning()):
        values.insert(X(k), pose)
    graph = odometry_graph(drive)
    marginals = Marginals(graph.linearize(values), colamd_ordering(graph))
    poses = list(poses_in(values, len(drive)).values())
    covariance = pose_covariances(marginals, len(drive))
    return replace(found.solution, poses=poses, pose_covariance=covariance, odometry_chi2=0.0)


def returned(p: FloatArray, path: FloatArray, near_m: float) -> IntArray:
    """Return the key poses that lie near one from which the vehicle had gone away.

    Parameters
    ----------
    p, path
        Of K key poses: positions and path length from the start in metres, shapes (K, 3) and (K,).
    near_m
        Distance within which the field is the same.
    """
    apart = np.linalg.norm(p[:, None] - p, axis=2)
    earlier = path[:, None] - path >= AWAY_M + near_m
    return np.flatnonzero((earlier & (apart <= near_m)).any(axis=1))
