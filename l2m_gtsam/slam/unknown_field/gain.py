r"""Whether corrected poses are nearer to the truth than odometry's, before a truth is known.

Two figures, for poses X of K key poses that readings z have corrected from those of odometry, O:

1. **The evidence.** By how much the readings are likelier at X than at O, with the field integrated
   out and their noise the likeliest at each, less what X costs against odometry:
   ``log p(z | X) - log p(z | O) - c(X)``. X are integrated out, too (Laplace): less by how much
   readings narrow the volume of poses, as those that fit their readings by chance are narrowed as
   much as others (:func:`narrowing`; :mod:`.path_information` for one field).
2. **The doubt.** Readings fit poses that they have moved themselves better than others, by
   hundreds of nats even where these are further off: a path that is right in itself may be turned
   as a whole. How far is in the sigmas. With positions ``x = x_X + e``, e of covariance P
   after all measurements, and ``d = x_O - x_X``, those of odometry are nearer where
   ``|e - d|^2 < |e|^2``, with the probability

.. math::
    p(2 d \cdot e > d \cdot d) = \Phi(-z), \quad z = \frac{|d|^2}{2 \sqrt{d^T P d}}

A correction that is short beside its own sigmas along its direction shows nothing.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.special import ndtr

from l2m_factors import M, X
from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import BoolArray
from l2m_gtsam.records.localisation import Gain
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.marginals import PoseCovariance, solved_drive
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import (
    calibration_graph,
    calibration_values,
    drive_graph,
    drive_values,
)
from l2m_gtsam.slam.relative_motion import DrivePrediction, RelativeMotions
from l2m_gtsam.slam.solver import marginals_of
from l2m_gtsam.slam.unknown_field.linear_field import AXES
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiled_smoother import AWAY_M, FieldSolution, in_map
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior
from l2m_gtsam.solve.robust import WEIGHTS

MOST_DOUBT = 0.05  # that odometry's poses are nearer
NOISE = np.geomspace(0.1, 10.0, 41)  # factors of the stated noise that are tried


def gain_of(
    poses: Sequence[gtsam.Pose3],
    odometry: Sequence[gtsam.Pose3],
    marginals: PoseCovariance,
    likelier: float,
) -> Gain:
    """Return what a correction of poses is worth.

    Parameters
    ----------
    poses, odometry
        K key poses, corrected and by odometry.
    marginals
        Of the corrected ones.
    likelier
        The evidence in nats.
    """
    d = np.stack([a.translation() - b.translation() for a, b in zip(odometry, poses, strict=True)])
    squared = float(np.sum(d**2))
    along = {
        X(k): np.append(np.zeros(3), pose.rotation().matrix().T @ own)
        for k, (pose, own) in enumerate(zip(poses, d, strict=True))
    }
    sigma = np.sqrt(marginals.variance_along(along)) if squared else 0.0
    doubt = float(ndtr(-0.5 * squared / sigma)) if sigma else 0.5
    moved = float(np.sqrt(squared / len(d)))
    return Gain(likelier, moved, doubt, shown=likelier > 0 and doubt <= MOST_DOUBT)


def readings_log_likelihood(tiled: TiledDrive, sensors: KnownSensors, used: BoolArray) -> float:
    """Return how likely readings are in tiles, their weights integrated out, but for constants.

    Parameters
    ----------
    tiled
        N readings in tiles at poses.
    sensors
        Calibrations.
    used
        Which readings count, shape (N,).
    """
    total = np.zeros(len(NOISE))
    for tile in tiled.tiles:
        own = np.flatnonzero(used[tile.rows])
        x, b = tile.placed.x[own], tile.placed.field(sensors)[own]
        variance = sensors.noise[tile.placed.readings.sensor[own], None] ** 2
        root = 1 / np.sqrt(variance + tile.field.unresolved(x))
        F = (tile.field.features(x) * root[:, :, None]).reshape(-1, len(tile.field))
        y = (b * root).ravel()
        # With F^T F = V diag(l) V^T, for each factor f of the noise
        # |y|^2 / f^2 - sum c^2 / (f^2 (f^2 + l)), and the determinant prod(1 + l / f^2).
        values, vectors = np.linalg.eigh(F.T @ F)
        values, c = np.maximum(values, 0.0), vectors.T @ (F.T @ y)
        f2 = NOISE[:, None] ** 2
        explained = np.sum(c**2 / (f2 * (f2 + values)), axis=1)
        total -= 0.5 * ((y @ y) / NOISE**2 - explained + np.log1p(values / f2).sum(axis=1))
        total += np.log(root).sum() - AXES * len(own) * np.log(NOISE)
    return float(total.max())


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
    calibrations that are variables, without readings and with them.
    """
    drive, tiles = mapped.solution.drive, mapped.tiled.tiles
    priors, values = drive_graph(drive), drive_values(drive, mapped.solution.poses)
    if options.calibration is CalibrationUse.REFINED:
        priors.push_back(calibration_graph(drive.sensors))
        values.insert(calibration_values(drive.sensors))
    before = marginals_of(priors, values).log_determinant()
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
    marginals = marginals_of(graph, values)
    sensors, robust = drive.sensors, options.robust
    motions = RelativeMotions.along(drive, poses)
    tiled = TiledDrive.lasting(motions, poses, sensors, prior)
    weights = tiled.weights(sensors, sensors.noise)
    predicted = DrivePrediction(motions, tiled.prediction(weights, sensors))
    trust = np.asarray(
        WEIGHTS[robust.loss](predicted.squared(sensors.noise), robust.largest, np.inf)
    )
    solution = replace(
        solved_drive(drive, values, marginals, predicted, trust, Ending.TOLERANCE),
        prediction=in_map(predicted, tiled, poses, sensors),
        odometry_chi2=0.0,  # no correction is made
        scale=None,
        turn=None,
        steady=None,
    )
    returns = tiled.anchoring.returns(drive.steps.path, AWAY_M)
    return FieldSolution(solution, tiled, returns, marginals, marginals)
