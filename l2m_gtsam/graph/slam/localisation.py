"""Localisation of a whole drive in a magnetic map, off line.

The drive is followed from its start, then all poses are solved together by Levenberg-Marquardt:
in rounds, with the weights that the residuals of the last round give each reading (graduated
non-convexity, see ``solve.robust``), at last with the map's errors as variables.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import CarriedBatch, key_pose_factor
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.graph.optimise import Ending, Optimizer, optimise
from l2m_gtsam.graph.slam.changes import LEAST_LEFT, ROUNDS, Fit, changed
from l2m_gtsam.graph.slam.covariances import (
    pose_covariances,
    sensor_covariances,
    solved_marginals,
)
from l2m_gtsam.graph.slam.drive import Drive, KnownSensors
from l2m_gtsam.graph.slam.factors import (
    calibration_graph,
    link_graph,
    link_squared,
    odometry_graph,
)
from l2m_gtsam.graph.slam.following import Follower, follow
from l2m_gtsam.graph.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.graph.slam.shared import SharedMapErrors, errors_of
from l2m_gtsam.graph.slam.sight import Sight, look, place, poses_in, sensors_in
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.progress import Progress
from l2m_gtsam.solve.robust import WEIGHTS

# Stages of the graduation: the drive was followed, so that no good reading is far off any more.
GRADUATION = (1.0, 10.0, float("inf"), float("inf"))
NOTHING = 1e-6  # a weight that is as good as none


@dataclass(frozen=True)
class Localised:
    """A drive in the map.

    Attributes
    ----------
    drive
        With its sensors as they came out.
    poses
        Key poses, K of them.
    pose_covariance
        Of right perturbations of them, rotation (rad) before translation (m), shape (K, 6, 6).
    calibration_covariance
        Of (t, C row by row, H) in m and uT, shape (S, 15, 15); as given where it was fixed.
    sight
        What the map says at the readings.
    squared
        Squared lengths of their whitened residuals, shape (N,).
    weights
        How far each reading counts, shape (N,); zero outside of the map.
    near_changes
        Which do not because of where they are: others about them do not fit, shape (N,).
    bent
        Mean square of the whitened components by which the steps between the poses differ from
        odometry's; 1 is consistent.
    link_squared
        Squared lengths of the whitened residuals of what scans say, shape (L,).
    ending
        How the last optimisation ended.
    """

    drive: Drive
    poses: list[gtsam.Pose3]
    pose_covariance: FloatArray
    calibration_covariance: FloatArray
    sight: Sight
    squared: FloatArray
    weights: FloatArray
    near_changes: BoolArray
    bent: float
    link_squared: FloatArray
    ending: Ending

    @property
    def used(self) -> BoolArray:
        """Which readings count, shape (N,)."""
        return np.asarray(self.weights > NOTHING)


def localise_drive(
    drive: Drive, field_map: QueryableMap, options: SlamOptions, progress: Progress
) -> Localised:
    """Find the poses of a drive, and its sensors' calibration if that is to be refined."""
    problem = Problem(drive, field_map, options)
    follower = Follower(drive, field_map, options.robust, free=problem.free)
    values = follow(follower, len(drive), progress)
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


@dataclass(frozen=True)
class Solved:
    """A round: variables, how far each reading counted, and how the optimiser ended."""

    values: gtsam.Values
    weights: FloatArray
    ending: Ending


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

    def look(self, values: gtsam.Values) -> Sight:
        """Ask the map where values put the readings."""
        sensors = self.sensors(values)
        poses = poses_in(values, len(self._drive))
        return look(self._map, place(self._drive.readings, poses, sensors), sensors)

    def weights(self, sight: Sight, mu: float) -> FloatArray:
        """Return how far each reading counts at a stage of the graduation, shape (N,)."""
        robust, r2 = self._options.robust, sight.squared(sight.whitening(self._drive.sensors.noise))
        return np.asarray(WEIGHTS[robust.loss](r2, robust.largest, mu) * sight.inside)

    def solved(self, values: gtsam.Values, counts: BoolArray, mu: float) -> Solved:
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
        sight = self.look(values)
        weights = self.weights(sight, mu) * counts
        graph = self.graph(sight, weights, sight.map_variance, None)
        end = optimise(graph, values, Optimizer.LM, self._options.max_iterations)
        return Solved(end.values, weights, end.ending)

    def fit(self, solved: Solved, counts: BoolArray) -> Fit:
        """Return how the readings that may count fit."""
        sight, readings = self.look(solved.values), self._drive.readings
        poses = poses_in(solved.values, len(self._drive)).values()
        return Fit(
            readings.key_pose,
            readings.sensor,
            sight.inside & counts,
            solved.weights > NOTHING,
            sight.squared(sight.whitening(self.sensors(solved.values).noise)),
            np.stack([pose.translation() for pose in poses]),
        )

    def graph(
        self,
        sight: Sight,
        weights: FloatArray,
        map_variance: FloatArray,
        shared: SharedMapErrors | None,
    ) -> gtsam.NonlinearFactorGraph:
        """Return all factors.

        Parameters
        ----------
        sight
            What the map says of the N readings.
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
        W = sight.whitening(drive.sensors.noise, map_variance)[rows]
        W = W * np.sqrt(weights[rows])[:, None, None]
        fixed = None if self.free else drive.sensors.fixed()
        batch = CarriedBatch(self._map, drive.readings[rows], fixed)
        for k in batch.key_poses:
            own = batch.rows_of(k)
            errors = () if shared is None else shared.of(rows[own])
            graph.add(key_pose_factor(batch, k, W[own], errors))
        if shared is not None:
            graph.add(shared.prior())
        return graph

    def finished(self, solved: Solved) -> Localised:
        """Solve once more with the map's errors as variables, and take the covariances."""
        values, ending = solved.values, solved.ending
        sight = self.look(values)
        weights = solved.weights * sight.inside
        shared = None
        if (weights > NOTHING).any():
            shared = SharedMapErrors.over(errors_of(self._map), sight)
            values.insert(shared.values())
        rest = sight.map_variance if shared is None else shared.rest
        graph = self.graph(sight, weights, rest, shared)
        optimised = optimise(graph, values, Optimizer.LM, self._options.max_iterations)
        values, sensors = optimised.values, self.sensors(optimised.values)
        marginals = solved_marginals(graph, values)
        sight = self.look(values)
        return Localised(
            drive=replace(self._drive, sensors=sensors),
            poses=list(poses_in(values, len(self._drive)).values()),
            pose_covariance=pose_covariances(marginals, len(self._drive)),
            calibration_covariance=(
                sensor_covariances(marginals, len(sensors.names))
                if self.free
                else sensors.covariance
            ),
            sight=sight,
            squared=sight.squared(sight.whitening(sensors.noise)),
            weights=weights * sight.inside,
            near_changes=np.zeros(len(weights), dtype=np.bool_),
            bent=2 * self._odometry.error(values) / (6 * len(self._drive)),
            link_squared=link_squared(self._drive.links, values),
            ending=optimised.ending if ending is Ending.TOLERANCE else ending,
        )
