"""How long errors of poses last."""

from dataclasses import dataclass
from enum import StrEnum


class DurationSource(StrEnum):
    """Where it is known from."""

    GIVEN = "given"
    """It was stated."""
    FOUND = "found"
    """The readings show it."""
    ASSUMED = "assumed"
    """Nothing was stated, and readings do not contradict what is assumed."""


@dataclass(frozen=True)
class PoseDuration:
    """How long errors of poses last, whose sizes were stated.

    Attributes
    ----------
    seconds
        Time over which the correlation of two errors falls to 1/e.
    source
        Where that is known from.
    """

    seconds: float
    source: DurationSource
