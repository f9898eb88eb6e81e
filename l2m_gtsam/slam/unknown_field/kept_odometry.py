"""A drive through an unknown field whose poses stay those of odometry and scans."""

from dataclasses import replace

import gtsam
import numpy as np

from l2m_factors import M
from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.marginals import Marginals, drive_covariances
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import (
    calibration_graph,
    calibration_values,
    drive_graph,
    drive_values,
    link_squared,
)
from l2m_gtsam.slam.relative_motion import DrivePrediction, RelativeMotions
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.solver import colamd_ordering
from l2m_gtsam.slam.unknown_field.gain import gain_of, readings_log_likelihood
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiled_smoother import AWAY_M, FieldSolution, in_map
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior
from l2m_gtsam.solve.robust import WEIGHTS


def with_gain(
    mapped: FieldSolution,
    recorded: Drive,
    odometry: list[gtsam.Pose3],
    prior: FieldPrior,
    options: SlamOptions,
) -> FieldSolution:
    """Return a drive in tiles with what its correction is worth.

    Parameters
    ----------
    mapped
        The drive with the poses that its readings correct.
    recorded
        The drive with its odometry as it was recorded.
    odometry
        Its K key poses by that and by scans.
    prior
        Of the field.
    options
        Loss of the readings.

    Returns
    -------
    The corrected poses; where nothing is shown to be gained, those of odometry with their sigmas.
    """
    solution = mapped.solution
    sensors, used = solution.drive.sensors, solution.used
    motions = RelativeMotions.along(recorded, odometry)
    drifted = max(  # tiles that end where a field seems another may explain the readings better
        readings_log_likelihood(divided(motions, odometry, sensors, prior), sensors, used)
        for divided in (TiledDrive.lasting, TiledDrive.renewed)
    )
    likelier = readings_log_likelihood(mapped.tiled, sensors, used) - drifted - solution.bent
    likelier -= narrowing(mapped, options)
    gain = gain_of(solution.poses, odometry, mapped.marginals, likelier)
    if gain.shown:
        return replace(mapped, gain=gain)
    return replace(along_odometry(recorded, odometry, prior, options), gain=gain)


def narrowing(mapped: FieldSolution, options: SlamOptions) -> float:
    """Return by how much readings narrow the volume of poses that odometry and scans allow.

    Half of the logarithm of ``det(Q) / det(P)``, with the covariances Q and P of poses, and of
    calibrations that are variables, without readings and with them. Poses that fit their readings
    by chance are narrowed as much as others: integrated out, the fit has to pay for it.
    """
    drive, tiles = mapped.solution.drive, mapped.tiled.tiles
    priors, values = drive_graph(drive), drive_values(drive, mapped.solution.poses)
    if options.calibration is CalibrationUse.REFINED:
        priors.push_back(calibration_graph(drive.sensors))
        values.insert(calibration_values(drive.sensors))
    before = Marginals(priors.linearize(values), colamd_ordering(priors)).log_determinant()
    return mapped.of_graph.log_determinant([M(tile.number) for tile in tiles]) - before


def along_odometry(
    drive: Drive, poses: list[gtsam.Pose3], prior: FieldPrior, options: SlamOptions
) -> FieldSolution:
    """Return a drive at poses by odometry and scans, with the field along them.

    Parameters
    ----------
    drive
        The drive; its calibrations count as they are.
    poses
        K key poses.
    prior, options
        As of ``with_gain``.
    """
    graph, values = drive_graph(drive), drive_values(drive, poses)
    marginals = Marginals(graph.linearize(values), colamd_ordering(graph))
    sensors, robust = drive.sensors, options.robust
    covariances = drive_covariances(marginals, drive, sensors, values)
    motions = RelativeMotions.along(drive, poses)
    tiled = TiledDrive.lasting(motions, poses, sensors, prior)
    weights = tiled.weights(sensors, sensors.noise)
    predicted = DrivePrediction(motions, tiled.prediction(weights, sensors))
    squared = predicted.squared(sensors.noise)
    solution = DriveSolution(
        drive=drive,
        poses=poses,
        pose_covariance=covariances.poses,
        calibration_covariance=sensors.covariance,
        prediction=in_map(predicted, tiled, poses, sensors),
        interpolation_covariance=predicted.interpolation_covariance,
        squared=squared,
        weights=np.asarray(WEIGHTS[robust.loss](squared, robust.largest, np.inf)),
        near_changes=np.zeros(len(squared), dtype=np.bool_),
        odometry_chi2=0.0,
        link_squared=link_squared(drive.links, values),
        ending=Ending.TOLERANCE,
        step_covariance=covariances.steps,
    )
    returns = tiled.anchoring.returns(drive.steps.path, AWAY_M)
    return FieldSolution(solution, tiled, returns, marginals, marginals)
