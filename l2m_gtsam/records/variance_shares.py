"""Which causes the uncertainty of a calibration comes from."""

from dataclasses import dataclass
from enum import StrEnum


class ErrorCause(StrEnum):
    """Whose errors make an estimate uncertain."""

    NOISE = "noise"
    """Of the readings, independent from one to the next."""
    MAP = "map"
    """Errors of the field map."""
    SUITE = "suite"
    """Errors of the sensors that surveyed it."""
    POSES = "poses"
    """Errors of the drive's poses."""
    WANDER = "wander"
    """H that is not constant, and noise that lasts."""
    FIELD = "field"
    """A field that is not the map's for a time."""
    WARP = "warp"
    """A frame that is bent against the map's."""
    CURRENTS = "currents"
    """What recorded numbers add to the readings."""
    PRIORS = "priors"
    """What was known of the sensor beforehand."""
    UNMODELLED = "unmodelled"
    """None of these: parts of the drive scatter more than all of them explain."""


@dataclass(frozen=True)
class VarianceShare:
    """What a cause has of the variances of a sensor's parameters.

    Attributes
    ----------
    cause
        Whose errors.
    t, C, H
        Share of the sum of the variances of the coordinates, entries and axes of each, 0 to 1; over
        all causes they add to one. Zero in all of them for what the drive does not determine.
    """

    cause: ErrorCause
    t: float
    C: float
    H: float
