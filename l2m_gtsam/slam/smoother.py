"""All poses of a drive in a known magnetic map, estimated together (batch smoothing).

The drive is followed from its start, then all poses are solved together by Gauss-Newton:
in rounds, with the weights that the residuals of the last round give each reading (graduated
non-convexity, see ``solve.robust``), at last with the map's errors as variables.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import MapBatch, key_pose_factor
from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.disturbances import LEAST_LEFT, ROUNDS, ReadingFits, changed
from l2m_gtsam.slam.drive import Drive, KnownSensors, stacked
from l2m_gtsam.slam.map_errors import SharedMapErrors, errors_of
from l2m_gtsam.slam.map_prediction import place_readings, poses_in, predict, sensors_in
from l2m_gtsam.slam.marginals import Marginals, solved_drive
from l2m_gtsam.slam.online.follower import Follower, follow
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import (
    calibration_graph,
    link_graph,
    odometry_graph,
    shared_values,
)
from l2m_gtsam.slam.relative_motion import DrivePrediction, RelativeMotions
from l2m_gtsam.slam.solution import REJECTED_WEIGHT, DriveSolution
from l2m_gtsam.slam.solver import colamd_ordering, gauss_newton
from l2m_gtsam.solve.robust import WEIGHTS

# Stages of graduated non-convexity: the drive was followed, so that good readings are near already.
GRADUATION = (1.0, 10.0, float("inf"), float("inf"))


@dataclass(frozen=True)
class SmoothingRound:
    """The solution of one round: variables, weights of N readings, why the optimiser stopped."""

    values: gtsam.Values
    weights: FloatArray
    ending: Ending


class SmoothingProblem:
    """The factor graph of a whole drive in a map.

    Parameters
    ----------
    drive
        K key poses with odometry, N readings and L scan links.
    field_map
        Map that is queried for field, gradient and variance.
    options
        Loss, calibration's use, and limit of iterations.
    """

    def __init__(self, drive: Drive, field_map: QueryableMap, options: SlamOptions) -> None:
        self._drive, self._map, self._options = drive, field_map, options
        self._free = options.calibration is CalibrationUse.REFINED
        self._odometry, self._links = odometry_graph(drive), link_graph(drive.links)

    def sensors(self, values: gtsam.Values) -> KnownSensors:
        """Return the sensors with the calibrations in values."""
        return sensors_in(values, self._drive.sensors)

    def predict(self, values: gtsam.Values) -> DrivePrediction:
        """Query the map at the readings' places by these values."""
        sensors, poses = self.sensors(values), poses_in(values, len(self._drive))
        motions = RelativeMotions.along(self._drive, poses)
        return DrivePrediction(
            motions, predict(self._map, place_readings(motions.readings, poses, sensors), sensors)
        )

    def weights(self, predicted: DrivePrediction, mu: float) -> FloatArray:
        """Return each reading's robust weight at a stage of the graduation, shape (N,)."""
        robust, r2 = self._options.robust, predicted.squared(self._drive.sensors.noise)
        return np.asarray(
            WEIGHTS[robust.loss](r2, robust.largest, mu) * predicted.prediction.inside
        )

    def solved(self, values: gtsam.Values, counts: BoolArray, mu: float) -> SmoothingRound:
        """Solve for all variables, with the readings' weights at the initial values.

        Parameters
        ----------
        values
            Initial values.
        counts
            Which readings may count, shape (N,).
        mu
            Stage of the graduation.
        """
        predicted = self.predict(values)
        weights = self.weights(predicted, mu) * counts
        graph = self.graph(predicted, weights, predicted.prediction.map_variance, None)
        end = gauss_newton(graph, values, colamd_ordering(graph), self._options.max_iterations)
        return SmoothingRound(end.values, weights, end.ending)

    def fit(self, solved: SmoothingRound, counts: BoolArray) -> ReadingFits:
        """Return the residuals of the readings that may count."""
        predicted, readings = self.predict(solved.values), self._drive.readings
        _, p = stacked(poses_in(solved.values, len(self._drive)))
        used = solved.weights > REJECTED_WEIGHT
        return ReadingFits(
            readings.key_pose,
            readings.sensor,
            predicted.prediction.inside & counts,
            used,
            predicted.independent(self.sensors(solved.values).noise, used),
            p,
        )

    def graph(
        self,
        predicted: DrivePrediction,
        weights: FloatArray,
        map_variance: FloatArray,
        shared: SharedMapErrors | None,
    ) -> gtsam.NonlinearFactorGraph:
        """Return all factors.

        Parameters
        ----------
        predicted
            The N readings at an estimate.
        weights
            Robust weights, shape (N,).
        map_variance
            The map's variance that counts as independent noise, per axis in uT^2, shape (N, 3).
        shared
            The map's errors that are variables, if any.
        """
        drive, graph = self._drive, gtsam.NonlinearFactorGraph()
        graph.push_back(self._odometry)
        graph.push_back(self._links)
        if self._free:
            graph.push_back(calibration_graph(drive.sensors))
        rows = np.flatnonzero(weights > REJECTED_WEIGHT)
        if not len(rows):
            return graph
        W = predicted.prediction.whitening(drive.sensors.noise, map_variance)
        W = W * np.sqrt(weights)[:, None, None]
        fixed = None if self._free else drive.sensors.fixed()
        batch = MapBatch(self._map, predicted.motions.readings[rows], fixed)
        for k in batch.key_poses:
            own = rows[batch.rows_of(k)]
            errors = () if shared is None else shared.of(own)
            by_lidar = predicted.prediction.by_lidar[own]
            white = predicted.motions.whitening(own, W[own], by_lidar)
            step = predicted.motions.step_error(own, by_lidar)
            graph.add(key_pose_factor(batch, k, white, errors, step))
        if shared is not None:
            graph.push_back(shared.prior())
        return graph

    def finished(self, solved: SmoothingRound) -> DriveSolution:
        """Solve once more with the map's errors as variables, and return covariances, too."""
        values, ending = solved.values, solved.ending
        predicted = self.predict(values)
        weights = solved.weights * predicted.prediction.inside
        shared = None
        if (weights > REJECTED_WEIGHT).any():
            shared = SharedMapErrors.over(errors_of(self._map), predicted.prediction)
            values.insert(shared.values())
        rest = predicted.prediction.map_variance if shared is None else shared.rest
        graph = self.graph(predicted, weights, rest, shared)
        order = colamd_ordering(graph)
        optimised = gauss_newton(graph, values, order, self._options.max_iterations)
        values, sensors = optimised.values, self.sensors(optimised.values)
        marginals = Marginals(graph.linearize(values), order)
        predicted = self.predict(values)
        return solved_drive(
            replace(self._drive, sensors=sensors),
            values,
            marginals,
            predicted,
            weights * predicted.prediction.inside,
            optimised.ending if ending is Ending.TOLERANCE else ending,
        )


def localise_drive(
    drive: Drive, field_map: QueryableMap, options: SlamOptions, progress: Progress
) -> DriveSolution:
    """Estimate the poses of a drive, and its calibrations if these are to be refined."""
    problem = SmoothingProblem(drive, field_map, options)
    followed = drive.as_walk(options.drift.over_m)
    follower = Follower(drive.start, drive.sensors, field_map, options)
    values = follow(follower, followed, progress)
    values.insert(shared_values(drive))
    counts = np.ones(len(drive.readings), dtype=np.bool_)
    for round_, mu in enumerate(GRADUATION):
        progress("solving all poses", round_ / len(GRADUATION))
        solved = problem.solved(values, counts, mu)
        values = solved.values
    whole = solved
    for _ in range(ROUNDS):
        left_out = changed(problem.fit(solved, counts))[drive.readings.key_pose]
        if not (left_out & counts).any():
            break
        counts = counts & ~left_out
        if np.mean(counts) < LEAST_LEFT:  # another place, not a changed one
            solved, counts = whole, np.ones_like(counts)
            break
        solved = problem.solved(solved.values, counts, np.inf)
    progress("solving all poses", 1.0)
    return replace(problem.finished(solved), near_changes=~counts)
