"""A drive on line while its start is searched for."""

from dataclasses import dataclass

from l2m_gtsam.slam.drive import StartPose
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose

MOST_WAITING = 2000  # key poses, of a vehicle that turns on the spot
SILENT_START_M = 1.0  # path before the first readings: it adds drift alone


@dataclass
class StartSearchState:
    """A drive whose start is searched for.

    Attributes
    ----------
    first
        Its first pose by odometry, of which the vertical counts.
    waiting
        Its key poses so far.
    window_m
        Path in metres of the next attempt.
    """

    first: StartPose
    waiting: list[ArrivedKeyPose]
    window_m: float

    @property
    def path_m(self) -> float:
        """Path of the key poses so far, metres."""
        return sum(each.length_m for each in self.waiting)

    def is_silent(self) -> bool:
        """Return whether no sensor has sent for so long that the search begins anew."""
        if any(len(each.readings) for each in self.waiting):
            return False
        return self.path_m > SILENT_START_M or self.is_full

    @property
    def is_full(self) -> bool:
        """Whether it has as many key poses as are kept."""
        return len(self.waiting) > MOST_WAITING

    def is_due(self, *, at_end: bool) -> bool:
        """Return whether there is path enough for the next attempt; at the end any is."""
        full = self.path_m >= self.window_m or self.is_full
        return len(self.waiting) > 1 and (full or at_end)
