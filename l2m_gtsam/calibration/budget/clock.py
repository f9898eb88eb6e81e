"""A clock that drifts: the time offset of a sensor is not constant over a drive.

A crystal is off by some 1e-5 of the time, stamps of a driver that buffers by 1e-4 and more: 100 ms
in three minutes. The offset of the middle of a drive is a variable of the graph; the rest is a
random walk about it, of which a steady drift is the slowest modes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_factors import PoseMotion, field_rate
from l2m_gtsam.calibration.budget.processes import Process, TimeModes, times_modes
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.error_budget import DisturbanceKind

CLOCK_MODES = 8  # slower ones hold all but a thousandth of a steady drift's variance


@dataclass(frozen=True)
class ClockDrift(Process):
    """The clock of a sensor walks against that of the poses."""

    sensor: int
    modes: TimeModes
    kind = DisturbanceKind.CLOCK

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of a random walk, s^2."""
        return (1 / np.square(np.pi * self.modes.frequency)[None],)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what seconds of delay make of the field on the way, shape (n, 3, m)."""
        places, readings = self.places, self.places.readings
        motion = None
        if readings.motion is not None:
            known = readings.motion[rows]
            motion = PoseMotion(known.twist_lidar, known.offset)
        slope = places.slope[rows] @ readings.R_map_lidar[rows]
        rate = field_rate(places.b_lidar[rows], slope, places.t[rows], motion)
        return times_modes(rate[:, :, None], self.modes.values(readings, rows))

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return how far the clock walks."""
        return {"drift_s": float(np.sqrt(sizes.sum()))}
