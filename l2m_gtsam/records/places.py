"""What changed at the places that a drive came through, and what else would explain it."""

import math
from dataclasses import dataclass
from enum import StrEnum

from l2m_gtsam.data import Vector


class Cause(StrEnum):
    """What a disagreement of readings and map is of."""

    PLACE = "place"
    MOMENT = "moment"
    VEHICLE = "vehicle"
    SENSOR = "sensor"


LARGEST = 1e6  # metres, A m^2


@dataclass(frozen=True)
class CauseGain:
    """How well a cause explains readings.

    Attributes
    ----------
    cause
        What may have changed.
    gain
        Twice the logarithm of its likelihood over that of no change, less what its parameters cost
        (the BIC): above zero it is better than nothing, the largest is the best.
    size
        Of the change at the readings concerned: root mean square in uT.
    """

    cause: Cause
    gain: float
    size: float


@dataclass(frozen=True)
class ChangedSource:
    """A source of field that came, went or was moved since the place was mapped.

    What went has the moment of its opposite; what was moved is two sources.

    Attributes
    ----------
    position, position_sigma
        Its middle in the map, and standard deviations, metres, shape (3,).
    moment, moment_sigma
        Map frame, A m^2, shape (3,).
    half_axis
        From its middle to one end in metres, zero for a dipole, shape (3,).
    gain
        What it explains that other sources do not: twice the logarithm of the likelihood ratio.
    nearest
        Distance of the nearest reading in metres.
    strongest
        Its strongest field at a reading in uT.
    passages
        How often the drive came to where it changes readings.
    explanations
        What the readings there say of each cause, the best first.
    """

    position: Vector
    position_sigma: Vector
    moment: Vector
    moment_sigma: Vector
    half_axis: Vector
    gain: float
    nearest: float
    strongest: float
    passages: int
    explanations: tuple[CauseGain, ...] = ()

    def __post_init__(self) -> None:
        """Raise a ValueError for steel that is nowhere: a file of others may hold anything."""
        for name in ("position", "position_sigma", "moment", "moment_sigma", "half_axis"):
            if not all(abs(float(each)) <= LARGEST for each in getattr(self, name)):
                raise ValueError(f"{name} must be finite numbers of at most {LARGEST:g}")

    @property
    def length_m(self) -> float:
        """Of a bar, end to end; zero of one that is too short to differ from a dipole."""
        whole = 2 * math.hypot(*self.half_axis)
        return whole if whole > LONG_M else 0.0

    @property
    def cause(self) -> Cause | None:
        """The cause that is clearly the best; none where two explain it about as well."""
        return clear_cause(self.explanations or (CauseGain(Cause.PLACE, 0.0, 0.0),))


def clear_cause(explanations: tuple[CauseGain, ...]) -> Cause | None:
    """Return the best cause, the first; none where another explains readings about as well.

    Nor where it explains no more than its parameters do by chance.
    """
    if not explanations:
        return None
    best, *others = explanations
    tied = any(best.gain - each.gain < CLEAR for each in others)
    return None if tied or best.gain < 0 else best.cause


LONG_M = 0.1  # shorter bars are reported as points


@dataclass(frozen=True)
class WhatChanged:
    """One explanation of all readings of a drive.

    Attributes
    ----------
    words
        What changed.
    gain
        Over that nothing did: twice the logarithm of the likelihood ratio, less what its
        parameters cost (the BIC).
    of_place
        Whether the place has changed by it.
    """

    words: str
    gain: float
    of_place: bool


CLEAR = 6.0  # of a gain: twice the logarithm of 20 to 1
