"""Readings between two key poses, beside what a map predicts from a belief."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import CarriedReadings, CarriedResiduals, carried_residuals
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.online.belief import Departed
from l2m_gtsam.slam.relative_motion import shifted_readings


@dataclass(frozen=True)
class Leg:
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

    readings: CarriedReadings
    step: gtsam.Pose3
    covariance: FloatArray

    @classmethod
    def of(cls, drive: Drive, rows: IntArray, number: int) -> "Leg":
        """Return some of a drive's readings, all on a key pose of this number."""
        return cls(drive.readings[rows], drive.step(number), drive.steps.covariance[number])

    def __getitem__(self, rows: IntArray) -> "Leg":
        return replace(self, readings=self.readings[rows])

    def __len__(self) -> int:
        return len(self.readings)

    def shifted(self, step: gtsam.Pose3) -> CarriedReadings:
        """Return the readings where they are if the step is this."""
        if step.equals(self.step, 0.0):
            return self.readings
        R, p = self.step.rotation(), self.step.translation()
        turn, shift = gtsam.Rot3.Logmap(R.between(step.rotation())), step.translation() - p
        return shifted_readings(self.readings, R.matrix(), p, turn, shift)


@dataclass(frozen=True)
class Seen:
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

    readings: CarriedReadings
    residuals: CarriedResiduals
    by_end: FloatArray

    @property
    def by_step(self) -> FloatArray:
        """Derivatives by a right perturbation of the step, shape (n, 3, 6)."""
        return np.asarray(self.readings.fraction[:, None, None] * self.by_end)


class LegView:
    """A leg beside a map, which is asked once where a belief is looked at again.

    Parameters
    ----------
    leg
        n readings.
    field_map
        The map.
    """

    def __init__(self, leg: Leg, field_map: QueryableMap) -> None:
        self.leg, self._map = leg, field_map
        self._at: Departed | None = None
        self._seen: Seen | None = None

    def of(self, rows: IntArray) -> "LegView":
        """Return the view of some readings: this one if they are all."""
        return self if len(rows) == len(self.leg) else LegView(self.leg[rows], self._map)

    def seen(self, belief: Departed) -> Seen:
        """Compare the readings with what the map predicts from a belief."""
        if self._seen is None or self._at is not belief:
            self._at, self._seen = belief, self._compared(belief)
        return self._seen

    def _compared(self, belief: Departed) -> Seen:
        n, pose, readings = len(self.leg), belief.pose, self.leg.shifted(belief.step)
        R, p = np.tile(pose.rotation().matrix(), (n, 1, 1)), np.tile(pose.translation(), (n, 1))
        seen = carried_residuals(readings, self._map, R, p, belief.sensors.fixed())
        return Seen(readings, seen, seen.de_dX @ belief.step.AdjointMap())
