"""Measurements of the filter: readings between two key poses, and scans, against predictions."""

from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from l2m_factors import KeyPoseReadings, KeyPoseResiduals, Whitening, key_pose_residuals
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import place_readings
from l2m_gtsam.slam.online.belief import POSE, SENSOR, Belief, PredictedBelief, WhitenedMeasurement
from l2m_gtsam.slam.pose_graph import stated_information_root
from l2m_gtsam.slam.relative_motion import bridge_whitening, shifted_readings
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening
from l2m_gtsam.solve.robust import WEIGHTS, RobustOptions

# Of cells over which the variance counts as constant: sigmas are off by a tenth, seldom a quarter.
CELL_M = 0.25


class CachedVariance:
    """A map's variance, asked once in each cell that is come to.

    A harmonic map needs a hundred times as long for it as for the field.

    Parameters
    ----------
    field_map
        The map.
    """

    def __init__(self, field_map: QueryableMap) -> None:
        self._map = field_map
        self._known: dict[tuple[int, ...], FloatArray] = {}

    def at(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis in uT^2, shape (N, 3); infinite outside of the map.

        It is that of the middle of the cell that a point lies in.

        Parameters
        ----------
        points
            In the map in metres, shape (N, 3).
        """
        cells = [tuple(cell) for cell in np.floor(points / CELL_M).astype(np.int64).tolist()]
        new = list({cell for cell in cells if cell not in self._known})
        if new:
            told = self._map.query(CELL_M * (np.array(new) + 0.5)).variance
            self._known.update(zip(new, told, strict=True))
        return np.stack([self._known[cell] for cell in cells])


@dataclass(frozen=True)
class StepReadings:
    """Readings between two key poses.

    Attributes
    ----------
    readings
        As odometry hangs them on the first of these, n in number.
    step
        The step to the second by odometry.
    covariance
        Of a right perturbation of it, shape (6, 6).
    """

    readings: KeyPoseReadings
    step: gtsam.Pose3
    covariance: FloatArray

    @classmethod
    def of(cls, drive: Drive, rows: IntArray, number: int) -> "StepReadings":
        """Return some of a drive's readings, all on a key pose of this number."""
        return cls(drive.readings[rows], drive.step(number), drive.steps.covariance[number])

    def __getitem__(self, rows: IntArray) -> "StepReadings":
        return replace(self, readings=self.readings[rows])

    def __len__(self) -> int:
        return len(self.readings)

    def shifted(self, step: gtsam.Pose3) -> KeyPoseReadings:
        """Return the readings where they are if the step is this."""
        if step.equals(self.step, 0.0):
            return self.readings
        R, p = self.step.rotation(), self.step.translation()
        turn, shift = gtsam.Rot3.Logmap(R.between(step.rotation())), step.translation() - p
        return shifted_readings(self.readings, R.matrix(), p, turn, shift)


@dataclass(frozen=True)
class StepPrediction:
    """Readings of a leg beside what a map predicts.

    Attributes
    ----------
    readings
        Where they are.
    residuals
        Residuals and derivatives.
    by_end
        Derivatives by a perturbation of the end of the step that the lidar were rigidly fixed to,
        shape (n, 3, 6).
    """

    readings: KeyPoseReadings
    residuals: KeyPoseResiduals
    by_end: FloatArray

    @property
    def by_step(self) -> FloatArray:
        """Derivatives by a right perturbation of the step, shape (n, 3, 6)."""
        return np.asarray(self.readings.fraction[:, None, None] * self.by_end)


class StepMeasurement:
    """A leg beside a map, which is asked once where a belief is looked at again.

    Parameters
    ----------
    leg
        n readings.
    field_map
        The map.
    """

    def __init__(self, leg: StepReadings, field_map: QueryableMap) -> None:
        self.leg, self._map = leg, field_map
        self._at: PredictedBelief | None = None
        self._seen: StepPrediction | None = None

    def of(self, rows: IntArray) -> "StepMeasurement":
        """Return the view of some readings: this one if they are all."""
        return self if len(rows) == len(self.leg) else StepMeasurement(self.leg[rows], self._map)

    def predicted(self, belief: PredictedBelief) -> StepPrediction:
        """Compare the readings with what the map predicts from a belief."""
        if self._seen is None or self._at is not belief:
            self._at, self._seen = belief, self._compared(belief)
        return self._seen

    def _compared(self, belief: PredictedBelief) -> StepPrediction:
        n, pose, readings = len(self.leg), belief.pose, self.leg.shifted(belief.step)
        R, p = np.tile(pose.rotation().matrix(), (n, 1, 1)), np.tile(pose.translation(), (n, 1))
        predicted = key_pose_residuals(readings, self._map, R, p, belief.sensors.fixed())
        return StepPrediction(readings, predicted, predicted.de_dX @ belief.step.AdjointMap())


MAX_RELINEARISATIONS = 3  # at what errors of the way do
NEAR = 0.03  # m, rad, or of an entry of C: there they do the same


@dataclass(frozen=True)
class Gated:
    """Readings of a leg that pass for such.

    Attributes
    ----------
    rows
        Which, shape (n,).
    own
        What makes the noise of each white, weighted by how far it counts, 1/uT, shape (n, 3, 3).
    """

    rows: IntArray
    own: FloatArray


@dataclass(frozen=True)
class Updated:
    """What is known once the readings of a leg were taken.

    Attributes
    ----------
    belief
        By them.
    whitening
        Of their residuals, there.
    by_step
        Their derivatives by a right perturbation of the step, shape (n, 3, 6).
    """

    belief: PredictedBelief
    whitening: Whitening
    by_step: FloatArray


def gate(
    view: StepMeasurement,
    variance: CachedVariance,
    belief: PredictedBelief,
    robust: RobustOptions,
) -> Gated:
    """Return the readings of a leg that a belief explains, by what it and they may be off."""
    leg, predicted, sensors = view.leg, view.predicted(belief), belief.sensors
    where = place_readings(
        predicted.readings, {int(k): belief.pose for k in leg.readings.key_pose[:1]}, sensors
    )
    known = variance.at(where.x)
    rows = np.flatnonzero(np.isfinite(known[:, 0]))
    R, sensor = where.readings.R_map_lidar[rows], leg.readings.sensor[rows]
    noise = reading_covariance(sensors.noise[sensor], map_covariance(where.C[rows], R, known[rows]))
    e, S = (
        predicted.residuals.reading.residual[rows],
        belief_covariance(leg, predicted, belief)[rows] + noise,
    )
    r2 = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[:, :, None])[:, :, 0])
    trust = WEIGHTS[robust.loss](r2, robust.largest, np.inf)
    good = np.flatnonzero(trust > 0)
    own = whitening(noise[good]) * np.sqrt(trust[good])[:, None, None]
    return Gated(rows[good], own)


def update(view: StepMeasurement, own: FloatArray, belief: PredictedBelief) -> Updated:
    """Return what is known by the readings of a leg, too.

    What the errors of the way do to them goes with the field's gradient and the calibration: it is
    looked at again where these come out elsewhere than they were taken for.

    Parameters
    ----------
    view, belief
        The readings, and what is known without them.
    own
        What makes the noise of each reading white, 1/uT, shape (n, 3, 3).
    """
    at, leg = belief, view.leg
    for _ in range(MAX_RELINEARISATIONS):
        predicted = view.predicted(at)
        white = bridge_whitening(own, predicted.by_end, leg.readings.fraction, leg.covariance)
        found = belief.updated(partial(whitened_measurement, view, white))
        if found.is_near(at, NEAR):
            break
        at = found
    return Updated(found, white, predicted.by_step)


def belief_covariance(
    leg: StepReadings, predicted: StepPrediction, belief: PredictedBelief
) -> FloatArray:
    """Return what an uncertain belief adds to the covariance of residuals, uT^2, (n, 3, 3).

    That is, by the pose, by the calibrations, and by the way from there.
    """
    P, sensor, residuals = belief.covariance, leg.readings.sensor, predicted.residuals
    parts = [residuals.de_dX, predicted.by_step]
    at = np.tile(np.append(np.arange(POSE), np.arange(len(P) - POSE, len(P))), (len(leg), 1))
    if belief.has_calibrations:
        parts += [residuals.reading.de_dt, residuals.reading.de_dD]
        at = np.hstack([at, columns_of(sensor)])
    J = np.concatenate(parts, axis=2)
    s = leg.readings.fraction[:, None, None]
    bridge = s * (1 - s) * (predicted.by_end @ leg.covariance @ predicted.by_end.transpose(0, 2, 1))
    return np.asarray(J @ P[at[:, :, None], at[:, None, :]] @ J.transpose(0, 2, 1) + bridge)


def whitened_measurement(
    view: StepMeasurement, white: Whitening, belief: PredictedBelief
) -> WhitenedMeasurement:
    """Return the n readings of a leg as evidence."""
    leg, predicted, n = view.leg, view.predicted(belief), len(view.leg)
    J = np.zeros((n, 3, len(belief.covariance)))
    J[:, :, :POSE], J[:, :, -POSE:] = predicted.residuals.de_dX, predicted.by_step
    reading = predicted.residuals.reading
    if belief.has_calibrations:
        by_sensor = np.concatenate([reading.de_dt, reading.de_dD], axis=2)
        at = np.arange(n)[:, None, None], np.arange(3)[:, None]
        J[(*at, columns_of(leg.readings.sensor)[:, None])] = by_sensor
    return WhitenedMeasurement(white(reading.residual[:, :, None]).ravel(), white(J))


def fix_measurement(
    fix: gtsam.Pose3, covariance: FloatArray, belief: Belief
) -> WhitenedMeasurement:
    """Return a key pose's place in the map, with its covariance (6, 6), as evidence."""
    W = stated_information_root(covariance)
    J = np.zeros((POSE, len(belief.covariance)))
    J[:, :POSE] = W
    return WhitenedMeasurement(W @ gtsam.Pose3.Logmap(fix.between(belief.pose)), J)


def columns_of(sensor: IntArray) -> IntArray:
    """Return which components of a belief are those of each reading's sensor, shape (n, 15)."""
    return np.asarray(POSE + SENSOR * sensor[:, None] + np.arange(SENSOR))
