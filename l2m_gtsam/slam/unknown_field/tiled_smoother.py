"""All poses of a drive and its unknown field as one factor graph, estimated together.

The field is described by tiles that are anchored to key poses. Poses and the tiles' weights are
solved together by Levenberg-Marquardt.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.optimise import TOLERANCE, Ending
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.localisation import Gain
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.map_prediction import MapPrediction, place_readings, poses_in, sensors_in
from l2m_gtsam.slam.marginals import (
    Marginals,
    PoseCovariance,
    solved_drive,
)
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import (
    calibration_graph,
    calibration_values,
    drive_values,
    link_graph,
    odometry_graph,
)
from l2m_gtsam.slam.relative_motion import DrivePrediction, RelativeMotions
from l2m_gtsam.slam.solution import REJECTED_WEIGHT, DriveSolution
from l2m_gtsam.slam.solver import levenberg_marquardt, weights_first
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise, SlowErrors
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior
from l2m_gtsam.solve.robust import WEIGHTS

AWAY_M = 5.0  # path length after which entering a tile again closes a loop


Divided = Callable[[RelativeMotions, list[gtsam.Pose3], KnownSensors], TiledDrive]
EliminationOrder = Callable[[gtsam.NonlinearFactorGraph, gtsam.Values], gtsam.Ordering]


@dataclass(frozen=True)
class FieldSolution:
    """A drive and the field along it.

    Attributes
    ----------
    solution
        Poses, sensors, and the tiles' predictions of the readings.
    tiled
        Its tiles.
    returns
        Numbers of the key poses that revisit a tile.
    of_graph
        Covariance of all variables of the graph.
    marginals
        Covariance of the poses.
    gain
        What the correction of odometry is worth, once that was asked; where nothing is shown to be
        gained the poses are odometry's.
    noise
        Of one sensor, or of several alike, where it is estimated from the drive.
    prior
        Of the tiles, as it was learnt; absent for one field.
    """

    solution: DriveSolution
    tiled: TiledDrive
    returns: IntArray
    of_graph: Marginals
    marginals: PoseCovariance
    gain: Gain | None = None
    noise: SensorNoise | None = None
    prior: FieldPrior | None = None

    @property
    def is_corrected(self) -> bool:
        """Whether the poses are those that the readings correct."""
        return self.gain is None or self.gain.shown


@dataclass(frozen=True)
class TiledRound:
    """The solution of one stage, with its tiles and the graph of what was measured.

    The complexity penalty is not in that graph. It has the right gradient, but is no measurement:
    the number of effective parameters is nearly linear in the positions, and the curvature of its
    squared residuals would count as information about them.
    """

    tiled: TiledDrive
    graph: gtsam.NonlinearFactorGraph
    weights: FloatArray
    values: gtsam.Values
    poses: list[gtsam.Pose3]
    sensors: KnownSensors
    ending: Ending


class TiledProblem:
    """The factor graph of a whole drive in an unknown field.

    Parameters
    ----------
    drive
        K key poses with odometry, N readings and L scan links.
    divided
        Divides the drive into tiles at an estimate of its motions, key poses and sensors.
    options
        Loss, calibration's use, and limit of iterations.
    ordering
        Elimination order of a graph's variables.
    slow
        Slow errors of the readings, parts of their noise; None where all of it is white.
    close
        Decrease of the error below which it has converged.
    """

    def __init__(
        self,
        drive: Drive,
        divided: Divided,
        options: SlamOptions,
        ordering: EliminationOrder = weights_first,
        slow: SlowErrors | None = None,
        close: float = TOLERANCE,
    ) -> None:
        self._drive, self._divided, self._options = drive, divided, options
        self._ordering, self._slow, self._close = ordering, slow, close
        self._odometry, self._links = odometry_graph(drive), link_graph(drive.links)
        self._free = options.calibration is CalibrationUse.REFINED

    def solved(
        self, poses: list[gtsam.Pose3], sensors: KnownSensors, scale: float, mu: float
    ) -> TiledRound:
        """Partition the drive into tiles at these poses, and solve for poses and weights.

        Parameters
        ----------
        poses, sensors
            Initial values.
        scale
            Factor of the readings' noise.
        mu
            Convexity of the loss.
        """
        motions = RelativeMotions.along(self._drive, poses)
        tiled = self._divided(motions, poses, sensors)
        noise = scale * sensors.noise
        values = tiled.weights(sensors, noise)
        values.insert(drive_values(self._drive, poses))
        predicted = DrivePrediction(motions, tiled.prediction(values, sensors))
        own = predicted.prediction.whitening(noise)
        robust = self._options.robust
        r2 = predicted.squared(noise)
        weights = np.asarray(WEIGHTS[robust.loss](r2, robust.largest, mu))
        if np.isinf(mu):  # before, poses may be wrong where readings are rejected
            weights = tiled.away_from_steel(weights)
        penalties = tiled.penalties(noise, weights, predicted.prediction.squared(own))
        chosen = np.flatnonzero(weights > REJECTED_WEIGHT)
        fixed = None if self._free else self._drive.sensors.fixed()
        if self._slow is not None:
            own = predicted.prediction.whitening(self._slow.white * noise)
            values.insert(self._slow.values())
        W, by_lidar = own * np.sqrt(weights)[:, None, None], predicted.prediction.by_lidar
        graph, doubts = tiled.graphs(motions, penalties, W, by_lidar, chosen, fixed, self._slow)
        graph.push_back(self._odometry)
        graph.push_back(self._links)
        if self._free:
            graph.push_back(calibration_graph(self._drive.sensors))
            values.insert(calibration_values(sensors))
        order = self._ordering(graph, values)
        limit, close = self._options.max_iterations, self._close
        doubts.push_back(graph)
        end = levenberg_marquardt(doubts, values, order, limit, close)
        found = poses_in(end.values, len(poses))
        after = sensors_in(end.values, sensors)
        return TiledRound(tiled, graph, weights, end.values, found, after, end.ending)

    def finished(self, solved: TiledRound) -> FieldSolution:
        """Return a solved stage with its covariances and residuals."""
        drive, sensors = self._drive, solved.sensors
        order = self._ordering(solved.graph, solved.values)
        marginals = Marginals(solved.graph.linearize(solved.values), order)
        motions = RelativeMotions.along(drive, solved.poses)
        tiled = solved.tiled.moved(motions, solved.poses, sensors)
        predicted = DrivePrediction(motions, tiled.prediction(solved.values, sensors))
        own = replace(drive, sensors=sensors)
        found = solved_drive(
            own, solved.values, marginals, predicted, solved.weights, solved.ending
        )
        solution = replace(found, prediction=in_map(predicted, tiled, solved.poses, sensors))
        path = drive.steps.path
        returns = tiled.anchoring.returns(path, AWAY_M)
        return FieldSolution(solution, tiled, returns, marginals, marginals)


def in_map(
    predicted: DrivePrediction, tiled: TiledDrive, poses: list[gtsam.Pose3], sensors: KnownSensors
) -> MapPrediction:
    """Return the tiles' predictions with positions and axes of the map."""
    placed = place_readings(predicted.motions.readings, poses, sensors)
    variance = np.empty_like(predicted.prediction.map_variance)
    for tile in tiled.tiles:
        R = poses[tile.anchor].rotation().matrix()
        variance[tile.rows] = predicted.prediction.map_variance[tile.rows] @ (R**2).T
    return replace(predicted.prediction, placed=placed, map_variance=variance)
