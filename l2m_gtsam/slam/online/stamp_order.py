"""Which of two stamps that do not follow each other is wrong, by the one after them.

A message that is older than the last may be late, or the last may be stamped ahead; one that comes
after a gap may be stamped ahead itself. It is held until the next one shows.
"""

from enum import Enum, auto


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
