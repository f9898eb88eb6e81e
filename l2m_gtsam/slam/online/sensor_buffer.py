"""Readings of one sensor that have come and wait for their key pose."""

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.recording.dropouts import LEAST_SAME
from l2m_gtsam.recording.sync import STUCK_UT
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.stamp_order import Held, decided

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
    held
        A reading that is older than the last: the next one decides which of both has a wrong stamp.
    """

    stamp_ns: list[int] = field(default_factory=list)
    values: list[FloatArray] = field(default_factory=list)
    last_ns: int = -1
    last: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    same: int = 0
    silent: bool = False
    stuck: bool = False
    disordered: bool = False
    held: tuple[int, FloatArray] | None = None

    def add(self, stamp_ns: int, value: FloatArray) -> list[EventKind]:
        """Take a finite reading, and return what is to be reported of it."""
        if stamp_ns == self.last_ns:
            return []  # sent twice
        found = self._settle(stamp_ns)
        if stamp_ns < self.last_ns:
            self.held = stamp_ns, value
            return found
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

    def _settle(self, next_ns: int) -> list[EventKind]:
        """Decide by the time of the next reading whether one that is held counts."""
        held, self.held = self.held, None
        if held is None:
            return []
        waiting = self.stamp_ns and self.stamp_ns[-1] == self.last_ns
        before_ns = self.stamp_ns[-2] if waiting and len(self.stamp_ns) > 1 else -np.inf
        if decided(held[0], next_ns, self.last_ns, before_ns) is Held.LAST_IS_AHEAD:
            self._take_back(*held)
            return []
        first, self.disordered = not self.disordered, True
        return [EventKind.OUT_OF_ORDER] if first else []

    def _take_back(self, held_ns: int, value: FloatArray) -> None:
        """Put a held reading in the place of the last one."""
        if self.stamp_ns and self.stamp_ns[-1] == self.last_ns:
            del self.stamp_ns[-1], self.values[-1]
        self.stamp_ns.append(held_ns)
        self.values.append(value)
        self.last_ns, self.last = held_ns, value

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
