"""What disturbed a drive beside noise, as its readings show it."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray


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
        ``walk_ut`` (from the start to the end of a drive) of H or of a field; of poses in the
        lidar's frame ``tilt_deg`` and ``floor_m`` (along x and y), ``heading_deg`` and
        ``height_m`` (along z); how long an error lasts, ``lasting_s``; ``shift_m``, of the
        floor's axes.
    gain
        Twice the logarithm by which the drive is more likely with it.
    sensor
        Whose readings it is in; all if none is named.
    """

    kind: DisturbanceKind
    sizes: dict[str, float]
    gain: float
    sensor: str | None = None


@dataclass(frozen=True)
class Unmodelled:
    """How many times larger the scatter of a drive's parts is than noise, map and poses explain.

    The covariances that are reported hold it, in the share of them that comes from the readings.
    One where the scatter is what is expected, or differs from it by no more than chance.

    Attributes
    ----------
    t, C, H, offset
        Mean over the parameters of each, in their own sigmas.
    """

    t: float = 1.0
    C: float = 1.0
    H: float = 1.0
    offset: float = 1.0

    @property
    def largest(self) -> float:
        """The largest of them."""
        return max(self.t, self.C, self.H, self.offset)

    @property
    def scale(self) -> FloatArray:
        """Factor of each sigma, t, C row by row, H, time offset, shape (16,)."""
        return np.asarray(np.sqrt(np.repeat([self.t, self.C, self.H, self.offset], (3, 9, 3, 1))))


EXPLAINED = Unmodelled()
