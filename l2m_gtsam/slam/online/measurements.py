"""Measurements of the filter: readings between two key poses, and scans, against predictions."""

from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from l2m_factors import KeyPoseReadings, KeyPoseResiduals, Whitening, key_pose_residuals
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.map_prediction import place_readings
from l2m_gtsam.slam.online.belief import POSE, SENSOR, Belief, PredictedBelief, WhitenedMeasurement
from l2m_gtsam.slam.pose_graph import stated_information_root
from l2m_gtsam.slam.relative_motion import bridge_whitening, shifted_readings
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening
from l2m_gtsam.solve.robust import WEIGHTS, RobustOptions

# Edge of cells over which the map's variance counts as constant: sigmas are off by 10 %, rarely 25.
# Its error counts as one there, too. On sixteen drives of a robot in maps of others NEES is 2 to
# 8, where 6 is consistent; with cells of 0.5 m 2 to 7, with errors of each reading's own 4 to 20.
CELL_M = 0.25
ELSEWHERE = 20  # key poses, after which a cell is come to anew
MAX_RELINEARISATIONS = 3  # of the covariance that odometry's errors within a step give readings
Cell = tuple[int, int, int]
CONVERGED = 0.03  # m, rad, or of an entry of C: the covariance changes no more


@dataclass
class CellVisit:
    """How many readings a visit of a cell has so far, and at which key pose the last one came."""

    count: int
    key_pose: int


class CachedVariance:
    """A map's variance, queried once per cell: a harmonic map takes 100 times as long as the field.

    Parameters
    ----------
    field_map
        Map with ``query``.
    """

    def __init__(self, field_map: QueryableMap) -> None:
        self._map = field_map
        self._known: dict[Cell, FloatArray] = {}
        self._visits: dict[Cell, CellVisit] = {}

    def at(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis in uT^2, shape (N, 3); infinite outside of the map.

        It is that of the centre of the cell that a point lies in.

        Parameters
        ----------
        points
            In the map in metres, shape (N, 3).
        """
        cells = cells_of(points)
        new = list({cell for cell in cells if cell not in self._known})
        if new:
            variance = self._map.query(CELL_M * (np.array(new) + 0.5)).variance
            self._known.update(zip(new, variance, strict=True))
        return np.stack([self._known[cell] for cell in cells])

    def one_by_one(self, points: FloatArray, noise: FloatArray, key_pose: int) -> FloatArray:
        """Return the variance with which the map's error adds to further readings, (N, 3), uT^2.

        Readings of a visit of a cell share it, and come one by one: to each is added as much as
        leaves it what it says beyond those before it.

        Parameters
        ----------
        points
            In the map in metres, shape (N, 3).
        noise
            Standard deviation of each reading's own noise in uT, shape (N,).
        key_pose
            Number of the one that they come with.
        """
        variance, count = self.at(points), self._counted(cells_of(points), key_pose)[:, None]
        # Of k readings of noise s^2 with one error of variance u the mean has u + s^2 / k.
        return np.asarray(
            (2 * count - 1) * variance + count * (count - 1) * variance**2 / noise[:, None] ** 2
        )

    def _counted(self, cells: list[Cell], key_pose: int) -> FloatArray:
        """Return which reading of its cell's visit each is, from 1 on, shape (N,)."""
        found = []
        for cell in cells:
            visit = self._visits.get(cell)
            if visit is None or key_pose - visit.key_pose > ELSEWHERE:
                visit = self._visits[cell] = CellVisit(0, key_pose)
            visit.count, visit.key_pose = visit.count + 1, key_pose
            found.append(visit.count)
        return np.array(found, dtype=np.float64)


def cells_of(points: FloatArray) -> list[Cell]:
    """Return the cells that points in metres, shape (N, 3), lie in."""
    return [(x, y, z) for x, y, z in np.floor(points / CELL_M).astype(np.int64).tolist()]


@dataclass(frozen=True)
class StepReadings:
    """Readings between two key poses.

    Attributes
    ----------
    readings
        n readings, relative to the first key pose by odometry.
    step
        The second key pose in the frame of the first, by odometry.
    covariance
        Of a right perturbation of the step, shape (6, 6).
    """

    readings: KeyPoseReadings
    step: gtsam.Pose3
    covariance: FloatArray

    def __getitem__(self, rows: IntArray) -> "StepReadings":
        return replace(self, readings=self.readings[rows])

    def __len__(self) -> int:
        return len(self.readings)

    def shifted(self, step: gtsam.Pose3) -> KeyPoseReadings:
        """Return the readings relative to the first key pose for another estimate of the step."""
        if step.equals(self.step, 0.0):
            return self.readings
        R, p = self.step.rotation(), self.step.translation()
        turn, shift = gtsam.Rot3.Logmap(R.between(step.rotation())), step.translation() - p
        return shifted_readings(self.readings, R.matrix(), p, turn, shift)


@dataclass(frozen=True)
class StepPrediction:
    """Readings of a step against the map's prediction.

    Attributes
    ----------
    readings
        n readings, relative to the first key pose by the estimate of the step.
    residuals
        Residuals in uT and their derivatives by first key pose and calibration.
    by_end
        Derivatives by a perturbation of the end of the step, as if the lidar were rigidly fixed to
        it, shape (n, 3, 6).
    """

    readings: KeyPoseReadings
    residuals: KeyPoseResiduals
    by_end: FloatArray

    @property
    def by_step(self) -> FloatArray:
        """Derivatives by a right perturbation of the step, shape (n, 3, 6)."""
        return np.asarray(self.readings.fraction[:, None, None] * self.by_end)


class StepMeasurement:
    """Readings of a step in a map, which is queried once per belief.

    Parameters
    ----------
    step
        n readings.
    field_map
        Map with ``field_and_gradient``.
    """

    def __init__(self, step: StepReadings, field_map: QueryableMap) -> None:
        self.step, self._map = step, field_map
        self._at: PredictedBelief | None = None
        self._prediction: StepPrediction | None = None

    def of(self, rows: IntArray) -> "StepMeasurement":
        """Return the measurement by some readings: this one if they are all."""
        if len(rows) == len(self.step):
            return self
        return StepMeasurement(self.step[rows], self._map)

    def predicted(self, belief: PredictedBelief) -> StepPrediction:
        """Compare the readings with what the map predicts at a belief."""
        if self._prediction is None or self._at is not belief:
            n, pose, readings = len(self.step), belief.pose, self.step.shifted(belief.step)
            R, p = np.tile(pose.rotation().matrix(), (n, 1, 1)), np.tile(pose.translation(), (n, 1))
            residuals = key_pose_residuals(readings, self._map, R, p, belief.sensors.fixed())
            by_end = residuals.de_dX @ belief.step.AdjointMap()
            self._at, self._prediction = belief, StepPrediction(readings, residuals, by_end)
        return self._prediction


@dataclass(frozen=True)
class Gated:
    """Readings of a step that passed the gate.

    Attributes
    ----------
    rows
        Their rows in the step, shape (n,).
    own
        Whitening of each one's own noise, times the root of its weight, 1/uT, shape (n, 3, 3).
    """

    rows: IntArray
    own: FloatArray


@dataclass(frozen=True)
class Updated:
    """A belief after the readings of a step.

    Attributes
    ----------
    belief
        The posterior, of the first key pose and the step.
    whitening
        Of the n residuals together.
    by_step
        Derivatives of the residuals by a right perturbation of the step, shape (n, 3, 6).
    log_likelihood
        Of the n readings by the prior, but for a constant of each.
    """

    belief: PredictedBelief
    whitening: Whitening
    by_step: FloatArray
    log_likelihood: float


def gate(
    measurement: StepMeasurement,
    variance: CachedVariance,
    belief: PredictedBelief,
    robust: RobustOptions,
) -> Gated:
    """Return the readings that the belief explains, by their Mahalanobis distances.

    Innovations are correlated through the belief; each is gated alone, by its own covariance.
    """
    step, sensors, prediction = measurement.step, belief.sensors, measurement.predicted(belief)
    poses = {int(k): belief.pose for k in step.readings.key_pose[:1]}
    placed = place_readings(prediction.readings, poses, sensors)
    known = variance.at(placed.x)
    rows = np.flatnonzero(np.isfinite(known[:, 0]))
    R, sensor = placed.readings.R_map_lidar[rows], step.readings.sensor[rows]
    of_map = map_covariance(placed.C[rows], R, known[rows])
    noise = reading_covariance(sensors.noise[sensor], of_map)
    S = belief_covariance(step, prediction, belief)[rows] + noise
    e = prediction.residuals.reading.residual[rows]
    r2 = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[:, :, None])[:, :, 0])
    trust = WEIGHTS[robust.loss](r2, robust.largest, np.inf)
    good = np.flatnonzero(trust > 0)
    if not len(good):
        return Gated(good, np.empty((0, 3, 3)))
    # A reading is judged by itself; those that count share the map's errors.
    own, x = sensors.noise[sensor[good]], placed.x[rows[good]]
    known = variance.one_by_one(x, own, int(step.readings.key_pose[0]))
    noise = reading_covariance(own, map_covariance(placed.C[rows[good]], R[good], known))
    return Gated(rows[good], whitening(noise) * np.sqrt(trust[good])[:, None, None])


def update(measurement: StepMeasurement, own: FloatArray, belief: PredictedBelief) -> Updated:
    """Return the belief updated by readings of a step.

    Odometry's errors within the step enter residuals through the field's gradient and the
    calibration. The residuals' covariance is computed again where these change in the update.

    Parameters
    ----------
    measurement
        n readings that passed the gate.
    own
        Whitening of each one's own noise, 1/uT, shape (n, 3, 3).
    belief
        Prior.
    """
    at, step = belief, measurement.step
    for again in range(MAX_RELINEARISATIONS):
        prediction = measurement.predicted(at)
        white = bridge_whitening(own, prediction.by_end, step.readings.fraction, step.covariance)
        measure = partial(whitened_measurement, measurement, white)
        if not again:
            likely = white.log_determinant + log_density(measure(belief), belief.covariance)
        posterior = belief.updated(measure)
        if posterior.is_near(at, CONVERGED):
            break
        at = posterior
    return Updated(posterior, white, prediction.by_step, likely)


def log_density(measured: WhitenedMeasurement, P: FloatArray) -> float:
    """Return the log density of a measurement at a belief of covariance P, but for constants."""
    J = measured.jacobian
    factor = np.linalg.cholesky(J @ P @ J.T + np.eye(len(J)))
    white = solve_triangular(factor, measured.residual, lower=True)
    return float(-0.5 * white @ white - np.log(np.diag(factor)).sum())


def belief_covariance(
    step: StepReadings, prediction: StepPrediction, belief: PredictedBelief
) -> FloatArray:
    """Return the covariance of residuals by an uncertain belief, uT^2, shape (n, 3, 3).

    Its parts are the pose, the calibrations, the step, and odometry's errors within the step.
    """
    P, sensor, residuals = belief.covariance, step.readings.sensor, prediction.residuals
    parts = [residuals.de_dX, prediction.by_step]
    at = np.tile(np.append(np.arange(POSE), np.arange(len(P) - POSE, len(P))), (len(step), 1))
    if belief.has_calibrations:
        parts += [residuals.reading.de_dt, residuals.reading.de_dD]
        at = np.hstack([at, columns_of(sensor)])
    J = np.concatenate(parts, axis=2)
    # Between two known ends odometry's random walk is a Brownian bridge of variance s (1 - s) Q.
    s, F = step.readings.fraction[:, None, None], prediction.by_end
    bridge = s * (1 - s) * (F @ step.covariance @ F.transpose(0, 2, 1))
    return np.asarray(J @ P[at[:, :, None], at[:, None, :]] @ J.transpose(0, 2, 1) + bridge)


def whitened_measurement(
    measurement: StepMeasurement, white: Whitening, belief: PredictedBelief
) -> WhitenedMeasurement:
    """Return the n readings of a step at a belief, white."""
    prediction, n = measurement.predicted(belief), len(measurement.step)
    J = np.zeros((n, 3, len(belief.covariance)))
    J[:, :, :POSE], J[:, :, -POSE:] = prediction.residuals.de_dX, prediction.by_step
    reading = prediction.residuals.reading
    if belief.has_calibrations:
        by_sensor = np.concatenate([reading.de_dt, reading.de_dD], axis=2)
        at = np.arange(n)[:, None, None], np.arange(3)[:, None]
        J[(*at, columns_of(measurement.step.readings.sensor)[:, None])] = by_sensor
    return WhitenedMeasurement(white(reading.residual[:, :, None]).ravel(), white(J))


def fix_measurement(
    fix: gtsam.Pose3, covariance: FloatArray, belief: Belief
) -> WhitenedMeasurement:
    """Return a key pose in the map, measured with a covariance of shape (6, 6), white."""
    W = stated_information_root(covariance)
    J = np.zeros((POSE, len(belief.covariance)))
    J[:, :POSE] = W
    return WhitenedMeasurement(W @ gtsam.Pose3.Logmap(fix.between(belief.pose)), J)


def columns_of(sensor: IntArray) -> IntArray:
    """Return the components of a belief that are each reading's sensor's, shape (n, 15)."""
    return np.asarray(POSE + SENSOR * sensor[:, None] + np.arange(SENSOR))
