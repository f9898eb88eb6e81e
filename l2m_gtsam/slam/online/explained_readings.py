"""How many of the last readings the map explains, along a drive."""

from collections import deque

from l2m_gtsam.slam.online.events import EventKind

LAST_KEY_POSES = 20  # that count
LEAST_READINGS = 40  # of which fewer say nothing
REFUSED, FITS = 0.4, 0.6  # share that is explained, below which it is reported, and above again


class ExplainedReadings:
    """The last readings, and how many of them the map explains."""

    def __init__(self) -> None:
        self._counts = deque[tuple[int, int]](maxlen=LAST_KEY_POSES)
        self._reported = False

    def forget(self) -> None:
        """Begin to count anew."""
        self._counts.clear()

    @property
    def is_telling(self) -> bool:
        """Whether there are enough, of readings or of key poses."""
        return self._seen >= LEAST_READINGS or len(self._counts) == LAST_KEY_POSES

    @property
    def are_few(self) -> bool:
        """Whether the map explains few of them."""
        return self._used < REFUSED * self._seen

    def add(self, seen: int, used: int) -> tuple[EventKind, str] | None:
        """Add the readings of a key pose, of which so many are used; return what is to be reported.

        That is where the map explains few of the last readings, and where it does again.
        """
        self._counts.append((seen, used))
        total, good = self._seen, self._used
        if total < LEAST_READINGS:
            return None
        if self.are_few and not self._reported:
            self._reported = True
            return EventKind.READINGS_REFUSED, (
                f"the map explains {good / total:.0%} of the last {total} readings: the vehicle is "
                "elsewhere, or the place has changed; poses follow odometry"
            )
        if good > FITS * total and self._reported:
            self._reported = False
            return EventKind.READINGS_FIT, "the map explains the readings again"
        return None

    @property
    def _seen(self) -> int:
        return sum(seen for seen, _ in self._counts)

    @property
    def _used(self) -> int:
        return sum(used for _, used in self._counts)
