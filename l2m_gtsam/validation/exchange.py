"""Sensors whose names or cables were exchanged: each reads what another's calibration predicts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from l2m_gtsam.calibration.trust import residuals
from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.verdict.validation import EXPECTED_TIMES
from l2m_gtsam.records.validation import ValidatedSensor
from l2m_gtsam.solve.robust import MEDIAN
from l2m_gtsam.validation.recheck import SensorDrive

OUTSIDE = 1e12  # uT^2: no reading tells


@dataclass(frozen=True)
class TestedSensor:
    """A sensor with its own calibration, and what was found with it."""

    drive: SensorDrive
    found: ValidatedSensor

    @property
    def misfits(self) -> bool:
        """Whether its calibration leaves far more of its readings than is expected."""
        return self.found.after.squared > self.most

    @property
    def most(self) -> float:
        """What may be left of the squared length of readings, uT^2."""
        return 3 * (EXPECTED_TIMES * self.found.expected) ** 2


def exchanged(sensors: Sequence[TestedSensor]) -> dict[str, str]:
    """Return, by name, whose calibration the readings of sensors fit that their own does not fit.

    Only whole exchanges count: each reads what another should, and is read by another.

    Parameters
    ----------
    sensors
        All that were tested.
    """
    wrong = [each for each in sensors if each.misfits]
    if len(wrong) < 2:
        return {}
    left = np.array(
        [[_left(replace(one.drive, known=of.drive.known)) for of in wrong] for one in wrong]
    )
    _, order = linear_sum_assignment(left)
    fits = left[range(len(wrong)), order] < [each.most for each in wrong]
    good = {k for k in range(len(wrong)) if fits[k] and order[k] != k}
    while dropped := {k for k in good if int(order[k]) not in good}:
        good -= dropped
    return {wrong[k].found.sensor: wrong[int(order[k])].found.sensor for k in good}


def _left(drive: SensorDrive) -> float:
    """Return the squared length that a calibration leaves of most readings of a sensor, uT^2."""
    readings = drive.timed.select(drive.inside())
    if not len(readings):
        return OUTSIDE
    e: FloatArray = residuals(readings, drive.field_map, drive.known.estimate())
    return 3 * float(np.median(np.sum(e**2, axis=1))) / MEDIAN
