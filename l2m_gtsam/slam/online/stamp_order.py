"""What stamps of messages say: which of two is wrong, by the one after them, and which is ahead.

A message that is older than the last may be late, or the last may be stamped ahead; one that comes
after a gap may be stamped ahead itself. It is held until the next one shows.
"""

from enum import Enum, auto
from numbers import Integral

from l2m_gtsam.errors import InputError

NS = 1e-9
AHEAD_S = 5.0  # a reading or a scan further ahead of odometry has a wrong stamp


class Held(Enum):
    """What becomes of a message that was held."""

    COUNTS = auto()
    """It came after a gap, and others come after it."""
    IS_AHEAD = auto()
    """It is stamped ahead of those after it: left out."""
    IS_LATE = auto()
    """It is older than the last: left out."""
    LAST_IS_AHEAD = auto()
    """It and the next are in order, and the last is stamped ahead of both: taken back for it."""


def decided(held_ns: int, next_ns: int | None, last_ns: int, before_ns: float) -> Held:
    """Return what becomes of a message that was held.

    Parameters
    ----------
    held_ns
        Its stamp.
    next_ns
        That of the message after it; none at the end.
    last_ns
        Of the last message that counted.
    before_ns
        Of the one before that; infinite where the last cannot be taken back, minus infinity where
        there is none.
    """
    if held_ns > last_ns:
        return Held.COUNTS if next_ns is None or held_ns < next_ns else Held.IS_AHEAD
    if next_ns is not None and before_ns < held_ns < next_ns < last_ns:
        return Held.LAST_IS_AHEAD
    return Held.IS_LATE


def require_stamp(stamp_ns: object) -> None:
    """Raise an InputError for a time that is no number of nanoseconds."""
    if not isinstance(stamp_ns, Integral):
        raise InputError(f"stamp_ns: {stamp_ns!r}; needed are nanoseconds as an integer")


def seconds_ahead(stamp_ns: int, odometry_ns: int | None) -> float:
    """Return by how much a stamp is too far ahead of the last pose of odometry; 0 if it is not."""
    ahead = 0.0 if odometry_ns is None else NS * (stamp_ns - odometry_ns)
    return ahead if ahead > AHEAD_S else 0.0
