"""Follow a drive from its start, key pose by key pose, with iSAM2.

Odometry drifts out of the reach of a descent within some tens of metres; followed from where the
drive begins, each key pose is found from the last, which the map has corrected already. There it
is known how far a reading may be off, and one that is further counts for nothing: a field that a
door adds to all sensors would otherwise be taken for a turn.
"""

import gtsam
import numpy as np
from scipy.linalg import block_diag

from l2m_factors import (
    CarriedBatch,
    CarriedReadings,
    D,
    T,
    X,
    carried_residuals,
    key_pose_factor,
)
from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.graph.slam.drive import Drive, KnownSensors, as_pose
from l2m_gtsam.graph.slam.factors import (
    calibration_graph,
    calibration_values,
    link_factor,
    link_pose,
    start_factor,
    step_factor,
)
from l2m_gtsam.graph.slam.sight import look, place, sensors_in
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.pose_covariance import moved
from l2m_gtsam.progress import Progress
from l2m_gtsam.solve.robust import WEIGHTS, RobustOptions

# Steps after which a variable is linearised anew: rad and m, as a map bends within decimetres;
# entries of C; never for H, in which readings are linear.
RELINEARISE = {
    "X": np.full(6, 0.01),
    "T": np.full(3, 0.01),
    "D": np.concatenate([np.full(9, 0.01), np.full(3, np.inf)]),
}
AGAIN = 2  # more steps at each key pose, so that the next starts from where this one converged


class Follower:
    """A drive as far as it was followed.

    Parameters
    ----------
    drive
        The drive.
    field_map
        The map.
    robust
        Which readings pass where a pose is predicted.
    free
        Whether calibrations are variables.
    """

    def __init__(
        self, drive: Drive, field_map: QueryableMap, robust: RobustOptions, *, free: bool
    ) -> None:
        self._drive, self._map, self._robust, self._free = drive, field_map, robust, free
        self._engine = _engine()
        self._ends = np.searchsorted(drive.readings.key_pose, np.arange(len(drive) + 1))

    def step(self, number: int) -> None:
        """Add a key pose; they come in order."""
        graph, values = self._begun() if number == 0 else self._gone_on(number)
        for fix in self._fixes(number, values):
            graph.add(fix)
        factor = self._readings(number, values)
        if factor is not None:
            graph.add(factor)
        self._engine.update(graph, values)
        for _ in range(AGAIN if factor is not None else 0):
            self._engine.update()

    def values(self) -> gtsam.Values:
        """Return all variables."""
        return self._engine.calculateEstimate()

    def _begun(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return what the first key pose adds beside its readings."""
        start, graph, values = self._drive.start, gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(start_factor(start))
        values.insert(X(0), as_pose(start.T_map_lidar))
        if self._free:
            graph.push_back(calibration_graph(self._drive.sensors))
            values.insert(calibration_values(self._drive.sensors))
        return graph, values

    def _gone_on(self, number: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return what a later key pose adds beside its readings."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(step_factor(self._drive, number - 1))
        last = self._engine.calculateEstimatePose3(X(number - 1))
        values.insert(X(number), last.compose(self._drive.step(number - 1)))
        return graph, values

    def _fixes(self, number: int, added: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """Return what scans say of a key pose's place in the map, as far as it passes for such."""
        links, pose = self._drive.links, added.atPose3(X(number))
        rows = np.flatnonzero(links.in_map & (links.key_pose == number))
        if not len(rows):
            return []
        expected, most = self._predicted_covariance(number), self._robust.largest_of(6)
        taken = []
        for row in rows.tolist():
            off = gtsam.Pose3.Logmap(pose.between(link_pose(links, row)))
            if off @ np.linalg.solve(expected + links.covariance[row], off) <= most:
                taken.append(link_factor(links, row))
        return taken

    def _readings(self, number: int, added: gtsam.Values) -> gtsam.NonlinearFactor | None:
        """Return the factor of a key pose's readings as far as they pass for such."""
        rows = np.arange(self._ends[number], self._ends[number + 1])
        if not len(rows):
            return None
        readings, sensors = self._drive.readings[rows], self._sensors(number)
        pose = added.atPose3(X(number))
        sight = look(self._map, place(readings, {number: pose}, sensors), sensors)
        unsure = self._unsure(number, readings, pose, sensors)
        r2 = sight.squared(sight.whitening(sensors.noise, more=unsure))
        trust = WEIGHTS[self._robust.loss](r2, self._robust.largest, np.inf)
        taken = np.flatnonzero(sight.inside & (trust > 0))
        if not len(taken):
            return None
        W = sight.whitening(sensors.noise) * np.sqrt(trust)[:, None, None]
        fixed = None if self._free else sensors.fixed()
        return key_pose_factor(CarriedBatch(self._map, readings[taken], fixed), number, W[taken])

    def _unsure(
        self, number: int, readings: CarriedReadings, pose: gtsam.Pose3, sensors: KnownSensors
    ) -> FloatArray:
        """Return what a predicted pose, and sensors, add to the covariance of residuals, uT^2.

        Shape (n, 3, 3). Errors of poses and sensors count as independent here, which takes
        readings for good a little too easily.
        """
        n = len(readings)
        R, p = np.tile(pose.rotation().matrix(), (n, 1, 1)), np.tile(pose.translation(), (n, 1))
        seen = carried_residuals(readings, self._map, R, p, sensors.fixed())
        covariance = spread_by(seen.de_dX, self._predicted_covariance(number))
        if self._free:
            by_sensor = np.concatenate([seen.reading.de_dt, seen.reading.de_dD], axis=2)
            known = self._sensor_covariances(number)[readings.sensor]
            covariance += spread_by(by_sensor, known)
        return covariance

    def _predicted_covariance(self, number: int) -> FloatArray:
        """Return the covariance of a key pose before its readings, shape (6, 6)."""
        if number == 0:
            return self._drive.start.covariance
        steps, last = self._drive.steps, self._engine.marginalCovariance(X(number - 1))
        step = RigidTransform(steps.R[number - 1], steps.p[number - 1])
        return np.asarray(moved(last[None], step)[0] + steps.covariance[number - 1])

    def _sensor_covariances(self, number: int) -> FloatArray:
        """Return the covariances of the sensors so far, shape (S, 15, 15)."""
        known = self._drive.sensors.covariance
        if number == 0:
            return known
        marginal = self._engine.marginalCovariance
        return np.stack([block_diag(marginal(T(i)), marginal(D(i))) for i in range(len(known))])

    def _sensors(self, number: int) -> KnownSensors:
        """Return the sensors as they are known when a key pose is added."""
        known = self._drive.sensors
        if not self._free or number == 0:
            return known
        so_far = gtsam.Values()
        for i in range(len(known.names)):
            so_far.insert(T(i), self._engine.calculateEstimatePoint3(T(i)))
            so_far.insert(D(i), self._engine.calculateEstimateVector(D(i)))
        return sensors_in(so_far, known)


def spread_by(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``J P J^T``, shape (n, 3, 3)."""
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))


def _engine() -> gtsam.ISAM2:
    """Return an empty graph that is solved as it grows."""
    thresholds = gtsam.ISAM2ThresholdMap()
    for symbol, steps in RELINEARISE.items():
        thresholds.insert((symbol, steps))
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    return gtsam.ISAM2(params)


def follow(follower: Follower, count: int, progress: Progress) -> gtsam.Values:
    """Follow a drive of so many key poses to its end and return its values."""
    for number in range(count):
        follower.step(number)
        progress("following the drive", (number + 1) / count)
    return follower.values()
