"""How well parts of a calibration agree: halves of a drive, and drives among each other.

They are in `metrics.json`; units are those of ``metrics``.
"""

from dataclasses import dataclass
from typing import Annotated

from l2m_gtsam.records.record import Record, Row, Shape


@dataclass(frozen=True)
class GroupDistance(Record):
    """How far two parts are apart in t, in C or in H, whatever they are in the others.

    Attributes
    ----------
    name
        ``t``, ``C`` or ``H``; for all of them together ``t, C and H``.
    chi_square
        Squared distance in the covariance of the difference.
    freedom
        Number of directions that both parts determine.
    """

    name: str
    chi_square: float
    freedom: int


@dataclass(frozen=True)
class Halves(Record):
    """One sensor calibrated on two parts: halves of a drive, or the other drives and one drive.

    Attributes
    ----------
    difference
        Second less first: t in metres, C row by row, H; shape (15,).
    sigma
        Standard deviation of each difference; infinite for what a part leaves open.
    distance
        Of both, root mean square over all directions that both parts determine, in sigmas: 1 is
        consistent.
    determined
        Number of those directions.
    turned_deg
        Angle between the rotations.
    reason
        Why there is no comparison; empty if there is one.
    groups
        t, C and H apart, as far as both parts determine some of them. Absent in older files.
    """

    difference: Row
    sigma: Row
    distance: float
    determined: int
    turned_deg: float
    reason: str = ""
    groups: tuple[GroupDistance, ...] | None = None

    @property
    def distances(self) -> tuple[GroupDistance, ...]:
        """What is judged: t, C and H apart, or all together where only that is known."""
        if self.groups is not None:
            return self.groups
        if self.reason:
            return ()
        return (GroupDistance("t, C and H", self.determined * self.distance**2, self.determined),)


@dataclass(frozen=True)
class DriveRepeat(Record):
    """One sensor calibrated on one of several drives by itself, beside the others.

    Attributes
    ----------
    bag
        Path of the drive.
    estimate, sigma
        t in metres, C row by row, H, and their standard deviations, shape (15,); NaN and infinite
        where the drive is not enough for it.
    others
        This drive less what the others say together.
    largest
        Largest part of that difference in sigmas: of t, of C and of H.
    """

    bag: str
    estimate: Annotated[Row, Shape("15")]
    sigma: Annotated[Row, Shape("15")]
    others: Halves
    largest: Row

    @property
    def reason(self) -> str:
        """Why there is no comparison; empty if there is one."""
        return self.others.reason


@dataclass(frozen=True)
class Repeatability(Record):
    """One sensor calibrated on each of several drives by itself.

    Attributes
    ----------
    squared
        Normalised square of what the drives differ by: the distance of all from their common
        value, in sigmas. What they share of the map's errors is not counted as a difference.
    freedom
        Its expected value.
    low, high
        Between these lie 95 % of such squares if nothing but noise differs; 0 without comparison.
    drives
        Each by itself, in the order of the recording.
    """

    squared: float
    freedom: int
    low: float
    high: float
    drives: tuple[DriveRepeat, ...]

    @property
    def compared(self) -> tuple[DriveRepeat, ...]:
        """Those that the others can be compared with."""
        return tuple(each for each in self.drives if not each.reason)
