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
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, WholeFieldOptions
from l2m_gtsam.slam.pose_graph import odometry_graph, shared_values
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.solver import Marginals, colamd_ordering, pose_covariances, weights_last
from l2m_gtsam.slam.unknown_field.forward_pass import FollowedDrive, followed
from l2m_gtsam.slam.unknown_field.tiled_smoother import AWAY_M, FieldSolution, TiledProblem
from l2m_gtsam.slam.unknown_field.whole_field import whole_prior

CONVEX = 1.0  # of the loss, with weights at the poses of the filter
# Factors of the readings' noise: with the noise alone the likelihood has maxima between the poses
# of odometry and the best ones.
COARSE = 2.0
STAGES = (COARSE, 1.0)
PASSES = 2  # of the filter


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
    whole = options.whole_field
    free = loosened(drive, whole)
    progress("following the drive", 0.0)
    start = followed_coarsely(free, initial, options)
    if start is None:
        return None
    poses = start.poses
    prior = whole_prior(free, poses, whole)
    if prior is None:
        return None
    refined = options.model_copy(update={"calibration": CalibrationUse.REFINED})
    problem = TiledProblem(free, prior.divided, refined, weights_last)
    sensors = free.sensors
    for stage, scale in enumerate(STAGES):
        progress("solving poses and field", stage / len(STAGES))
        solved = problem.solved(poses, sensors, scale, CONVEX)
        poses, sensors = solved.poses, solved.sensors
    found = problem.finished(solved)
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


def loosened(drive: Drive, options: WholeFieldOptions) -> Drive:
    """Return a drive whose sensors may have steel beside them."""
    return replace(drive, sensors=drive.sensors.loosened(options.distortion, options.offset))


def followed_coarsely(
    drive: Drive, initial: list[gtsam.Pose3], options: SlamOptions
) -> FollowedDrive | None:
    """Follow a drive twice, with the field learnt at its start and again at the poses found.

    Parameters
    ----------
    drive
        The drive, its sensors loosened.
    initial
        K key poses by odometry.
    options
        How the field is described.

    Returns
    -------
    None where the field has more detail than one basis holds.
    """
    whole, noise = options.whole_field, COARSE * drive.sensors.noise
    coarse = replace(drive, sensors=replace(drive.sensors, noise=noise))
    scaled = coarse.with_scale_as_drift(options.drift.over_m)
    poses, over_m = initial, options.tiles.learn_over_m
    for _ in range(PASSES):
        prior = whole_prior(coarse, poses, whole, over_m)
        if prior is None:
            return None
        found = followed(scaled, prior.field, initial[0], options.robust.largest)
        poses, over_m = found.poses, np.inf
    return found


def likelihood(drive: Drive, options: SlamOptions) -> float:
    """Return the log likelihood of a drive's readings given its odometry, but for constants.

    Poses and field are integrated out. Minus infinity where one basis does not hold the field.
    """
    found = followed_coarsely(loosened(drive, options.whole_field), drive.dead_reckoning(), options)
    return -np.inf if found is None else found.log_likelihood


def unchanged(drive: Drive, found: FieldSolution) -> DriveSolution:
    """Return a solution with the poses and covariances of odometry alone."""
    values = shared_values(drive)
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
