"""What disturbed a drive beside noise, as it was found in its readings."""

from dataclasses import dataclass
from enum import StrEnum


class DisturbanceKind(StrEnum):
    """What kind of process."""

    WANDER = "wander"
    """H of a sensor is not constant, or its noise lasts."""
    POSES = "poses"
    """Poses are wrong by errors that last."""
    FIELD = "field"
    """The field is not the map's for a time, for all sensors alike."""
    WARP = "warp"
    """The drive's frame is bent against the map's."""


@dataclass(frozen=True)
class Disturbance:
    """A process that was found on a drive, and that sigmas hold.

    Attributes
    ----------
    kind
        What it is.
    sizes
        Standard deviations by name and unit, along each axis: ``noise_ut`` (that lasts, 1/f) and
        ``walk_ut`` (from the start to the end of a drive) of H or of a field; ``rotation_deg``,
        ``position_m`` and for how long, ``lasting_s``; ``shift_m``, of the floor's axes.
    gain
        Twice the logarithm by which the drive is more likely with it.
    sensor
        Whose readings it is in; all if none is named.
    """

    kind: DisturbanceKind
    sizes: dict[str, float]
    gain: float
    sensor: str | None = None
