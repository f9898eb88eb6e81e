"""All poses of a drive in a known magnetic map, estimated together (batch smoothing).

The drive is followed from its start, then all poses are solved together by Levenberg-Marquardt:
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
from l2m_gtsam.slam.disturbances import LEAST_LEFT, ROUNDS, Fit, changed
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.map_prediction import (
    MapPrediction,
    SharedMapErrors,
    errors_of,
    place_readings,
    poses_in,
    predict,
    sensors_in,
)
from l2m_gtsam.slam.online.follower import Follower, follow
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import (
    calibration_graph,
    link_graph,
    link_squared,
    odometry_graph,
    scale_values,
)
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solution import NOTHING, DriveSolution
from l2m_gtsam.slam.solver import (
    Marginals,
    colamd_ordering,
    descended,
    odometry_scale,
    pose_covariances,
    sensor_covariances,
)
from l2m_gtsam.solve.robust import WEIGHTS


@dataclass(frozen=True)
class SmoothingRound:
    """A round: variables, how far each reading counted, and how the optimiser ended."""

    values: gtsam.Values
    weights: FloatArray
    ending: Ending


@dataclass(frozen=True)
class DrivePrediction:
    """A drive's N readings at an estimate.

    Attributes
    ----------
    ways
        Between the key poses.
    prediction
        What the map says where they lead to.
    """

    motions: RelativeMotions
    prediction: MapPrediction

    @property
    def interpolation_covariance(self) -> FloatArray:
        """What errors of the ways contribute to the covariance of residuals, (N, 3, 3)."""
        return self.motions.interpolation_covariance(
            np.arange(len(self.prediction.inside)), self.prediction.by_lidar
        )

    def squared(self, noise: FloatArray) -> FloatArray:
        """Return squared lengths of residuals, each whitened by all that it may be off, (N,)."""
        return self.prediction.squared(
            self.prediction.whitening(noise, extra=self.interpolation_covariance)
        )

    def independent(self, noise: FloatArray, used: BoolArray) -> FloatArray:
        """Return squared lengths of residuals without what those of a step have in common, (N,).

        Zero for those that are not used or outside of the map.
        """
        prediction, squared = self.prediction, np.zeros(len(used))
        own = prediction.whitening(noise)
        rows = np.flatnonzero(used & prediction.inside)
        key = self.motions.readings.key_pose[rows]
        for part in np.split(rows, np.flatnonzero(np.diff(key)) + 1) if len(rows) else ():
            white = self.motions.whitening(part, own[part], prediction.by_lidar[part])
            e = white(prediction.residual[part, :, None]).reshape(-1, 3)
            squared[part] = np.einsum("ni,ni->n", e, e)
        return squared


class Problem:
    """The graph of a drive.

    Parameters
    ----------
    drive
        The drive.
    field_map
        The map.
    options
        How to solve.
    """

    def __init__(self, drive: Drive, field_map: QueryableMap, options: SlamOptions) -> None:
        self._drive, self._map, self._options = drive, field_map, options
        self._odometry, self._links = odometry_graph(drive), link_graph(drive.links)

    @property
    def free(self) -> bool:
        """Whether calibrations are variables."""
        return self._options.calibration is CalibrationUse.REFINED

    def sensors(self, values: gtsam.Values) -> KnownSensors:
        """Return the sensors as values have them."""
        return sensors_in(values, self._drive.sensors)

    def predict(self, values: gtsam.Values) -> DrivePrediction:
        """Ask the map where values put the readings."""
        sensors, poses = self.sensors(values), poses_in(values, len(self._drive))
        motions = RelativeMotions.along(self._drive, list(poses.values()))
        return DrivePrediction(
            motions, predict(self._map, place_readings(motions.readings, poses, sensors), sensors)
        )

    def weights(self, seen: DrivePrediction, mu: float) -> FloatArray:
        """Return how far each reading counts at a stage of the graduation, shape (N,)."""
        robust, r2 = self._options.robust, seen.squared(self._drive.sensors.noise)
        return np.asarray(WEIGHTS[robust.loss](r2, robust.largest, mu) * seen.prediction.inside)

    def solved(self, values: gtsam.Values, counts: BoolArray, mu: float) -> SmoothingRound:
        """Solve for everything, with readings weighted as they fit now.

        Parameters
        ----------
        values
            Where to start.
        counts
            Which readings may count, shape (N,).
        mu
            Stage of the graduation.
        """
        seen = self.predict(values)
        weights = self.weights(seen, mu) * counts
        graph = self.graph(seen, weights, seen.prediction.map_variance, None)
        end = descended(graph, values, colamd_ordering(graph), self._options.max_iterations)
        return SmoothingRound(end.values, weights, end.ending)

    def fit(self, solved: SmoothingRound, counts: BoolArray) -> Fit:
        """Return how the readings that may count fit."""
        seen, readings = self.predict(solved.values), self._drive.readings
        poses = poses_in(solved.values, len(self._drive)).values()
        used = solved.weights > NOTHING
        return Fit(
            readings.key_pose,
            readings.sensor,
            seen.prediction.inside & counts,
            used,
            seen.independent(self.sensors(solved.values).noise, used),
            np.stack([pose.translation() for pose in poses]),
        )

    def graph(
        self,
        seen: DrivePrediction,
        weights: FloatArray,
        map_variance: FloatArray,
        shared: SharedMapErrors | None,
    ) -> gtsam.NonlinearFactorGraph:
        """Return all factors.

        Parameters
        ----------
        seen
            The N readings where they are taken to be.
        weights
            How far they count, shape (N,).
        map_variance
            Of the map per axis that counts as noise of each reading in uT^2, shape (N, 3).
        shared
            The map's errors that do not.
        """
        drive, graph = self._drive, gtsam.NonlinearFactorGraph()
        graph.push_back(self._odometry)
        graph.push_back(self._links)
        if self.free:
            graph.push_back(calibration_graph(drive.sensors))
        rows = np.flatnonzero(weights > NOTHING)
        if not len(rows):
            return graph
        W = seen.prediction.whitening(drive.sensors.noise, map_variance)
        W = W * np.sqrt(weights)[:, None, None]
        fixed = None if self.free else drive.sensors.fixed()
        batch = MapBatch(self._map, seen.motions.readings[rows], fixed)
        for k in batch.key_poses:
            own = rows[batch.rows_of(k)]
            errors = () if shared is None else shared.of(own)
            by_lidar = seen.prediction.by_lidar[own]
            white = seen.motions.whitening(own, W[own], by_lidar)
            step = seen.motions.step_error(own, by_lidar)
            graph.add(key_pose_factor(batch, k, white, errors, step))
        if shared is not None:
            graph.add(shared.prior())
        return graph

    def finished(self, solved: SmoothingRound) -> DriveSolution:
        """Solve once more with the map's errors as variables, and take the covariances."""
        values, ending = solved.values, solved.ending
        seen = self.predict(values)
        weights = solved.weights * seen.prediction.inside
        shared = None
        if (weights > NOTHING).any():
            shared = SharedMapErrors.over(errors_of(self._map), seen.prediction)
            values.insert(shared.values())
        rest = seen.prediction.map_variance if shared is None else shared.rest
        graph = self.graph(seen, weights, rest, shared)
        order = colamd_ordering(graph)
        optimised = descended(graph, values, order, self._options.max_iterations)
        values, sensors = optimised.values, self.sensors(optimised.values)
        marginals = Marginals(graph.linearize(values), order)
        seen = self.predict(values)
        return DriveSolution(
            drive=replace(self._drive, sensors=sensors),
            poses=list(poses_in(values, len(self._drive)).values()),
            pose_covariance=pose_covariances(marginals, len(self._drive)),
            calibration_covariance=(
                sensor_covariances(marginals, len(sensors.names))
                if self.free
                else sensors.covariance
            ),
            prediction=seen.prediction,
            interpolation_covariance=seen.interpolation_covariance,
            squared=seen.squared(sensors.noise),
            weights=weights * seen.prediction.inside,
            near_changes=np.zeros(len(weights), dtype=np.bool_),
            bent=2 * self._odometry.error(values) / (6 * len(self._drive)),
            scale=odometry_scale(marginals, values),
            link_squared=link_squared(self._drive.links, values),
            ending=optimised.ending if ending is Ending.TOLERANCE else ending,
        )


# Stages of the graduation: the drive was followed, so that no good reading is far off any more.
GRADUATION = (1.0, 10.0, float("inf"), float("inf"))


def localise_drive(
    drive: Drive, field_map: QueryableMap, options: SlamOptions, progress: Progress
) -> DriveSolution:
    """Find the poses of a drive, and its sensors' calibration if that is to be refined."""
    problem = Problem(drive, field_map, options)
    followed = drive.with_scale_as_drift(options.drift.over_m)
    follower = Follower(followed, field_map, options.robust, free=problem.free)
    values = follow(follower, len(drive), progress)
    values.insert(scale_values(drive))
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
        if np.mean(counts) < LEAST_LEFT:  # this is no change of a place, but another one
            solved, counts = whole, np.ones_like(counts)
            break
        solved = problem.solved(solved.values, counts, np.inf)
    progress("solving all poses", 1.0)
    return replace(problem.finished(solved), near_changes=~counts)
