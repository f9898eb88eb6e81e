"""Readings of one sensor that have come and wait for their key pose."""

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.recording.dropouts import LEAST_SAME
from l2m_gtsam.recording.sync import STUCK_UT
from l2m_gtsam.slam.online.events import EventKind

MOST_WAITING = 512  # of a vehicle that is parked: every other one is dropped then


@dataclass
class SensorBuffer:
    """What is known of one sensor on line.

    Attributes
    ----------
    stamp_ns, values
        Its waiting readings, in order of time; uT.
    last_ns
        Stamp of the last reading that was finite and in order, waiting or not.
    last
        Its value.
    same
        How many readings in a row have had it.
    silent, stuck, disordered
        What was reported of it and has not ended.
    """

    stamp_ns: list[int] = field(default_factory=list)
    values: list[FloatArray] = field(default_factory=list)
    last_ns: int = -1
    last: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    same: int = 0
    silent: bool = False
    stuck: bool = False
    disordered: bool = False

    def add(self, stamp_ns: int, value: FloatArray) -> list[EventKind]:
        """Take a finite reading, and return what is to be reported of it."""
        if stamp_ns <= self.last_ns:
            first, self.disordered = not self.disordered, True
            return [EventKind.OUT_OF_ORDER] if first else []
        found = []
        repeated = bool(np.abs(value - self.last).max() < STUCK_UT)
        self.same = self.same + 1 if repeated else 1
        if (self.silent or self.stuck) and not repeated:
            self.silent = self.stuck = False
            found.append(EventKind.SENSOR_BACK)
        self.last_ns, self.last, self.disordered = stamp_ns, value, False
        self.stamp_ns.append(stamp_ns)
        self.values.append(value)
        if len(self.stamp_ns) > MOST_WAITING:
            del self.stamp_ns[1::2], self.values[1::2]
        return found

    def check(self, now_ns: int, silent_ns: int, *, moved: bool) -> list[EventKind]:
        """Return what is to be reported at a key pose; drop readings of a sensor that is stuck.

        Parameters
        ----------
        now_ns
            Time of the key pose.
        silent_ns
            Time without readings after which a sensor is silent.
        moved
            Whether the vehicle has moved since the key pose before.
        """
        if self.same >= LEAST_SAME and moved:
            first, self.stuck = not self.stuck, True
            return [EventKind.SENSOR_STUCK] if first else []
        if self.last_ns < now_ns - silent_ns and not self.silent and not self.stuck:
            self.silent = True
            return [EventKind.SENSOR_SILENT]
        return []

    def take(self, until_ns: int) -> tuple[IntArray, FloatArray]:
        """Remove the readings up to a time and return them, (n,) and (n, 3); none while stuck."""
        count = bisect_right(self.stamp_ns, until_ns)
        stamps, values = self.stamp_ns[:count], self.values[:count]
        del self.stamp_ns[:count], self.values[:count]
        if self.stuck:
            stamps, values = [], []
        return np.array(stamps, dtype=np.int64), np.reshape(values, (-1, 3))
