"""What a map went through: drives that it was given, steel that changed, stretches that went."""

import re
from dataclasses import dataclass
from enum import StrEnum

from l2m_gtsam.records.places import LARGEST, ChangedSource

DATE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z")


HIDDEN = "came: or steel of the opposite moment went that the survey's cloud does not show"


class Happening(StrEnum):
    """What happened to steel."""

    CAME = "came"
    WENT = "went"
    EITHER = "came or went"
    """Steel came, or steel of the opposite moment went that no survey had seen."""


@dataclass(frozen=True)
class MapDrive:
    """A drive, or the survey, that a map was given.

    Attributes
    ----------
    begun, ended
        First and last pose, as ISO dates and times in UTC; absent where the map does not know.
    """

    begun: str | None
    ended: str | None

    def __post_init__(self) -> None:
        """Raise a ValueError for anything else: a file of others may hold anything."""
        for each in (self.begun, self.ended):
            if each is not None and not DATE.fullmatch(each):
                raise ValueError("dates of drives are like 2026-11-23T14:05:09Z")

    @property
    def day(self) -> str:
        """The day that it ended, in UTC, or that it is not known."""
        return "not dated" if self.ended is None else self.ended[:10]


UNDATED = MapDrive(None, None)


@dataclass(frozen=True)
class DatedChange:
    """Steel that came or went, and between which drives.

    Attributes
    ----------
    what
        Whether it came or went.
    source
        Place, moment and extent; of steel that went the moment is the opposite of its own.
    drive
        Number of the first drive that saw it so; the survey is 0.
    before
        Number of the last drive that was there and saw it otherwise.
    other
        Index of the change that this one belongs to: where steel that came was taken from, or which
        change brought the steel that went; absent where it is not known.
    """

    what: Happening
    source: ChangedSource
    drive: int
    before: int
    other: int | None = None

    @property
    def went(self) -> bool:
        """Whether steel is no longer there that the map had, or that was brought before."""
        return self.what is Happening.WENT


@dataclass(frozen=True)
class FadedStretch:
    """A square of the floor where readings of earlier drives count less, or no longer.

    Attributes
    ----------
    middle
        In the map frame in metres, shape (2,).
    edge
        Of the square in metres.
    drive
        Number of the drive that disagreed.
    kept
        Share of what the earlier readings knew that still counts, 0 to 1.
    """

    middle: tuple[float, float]
    edge: float
    drive: int
    kept: float

    def __post_init__(self) -> None:
        """Raise a ValueError for squares that are nowhere."""
        numbers = (*self.middle, self.edge)
        if not (all(abs(each) <= LARGEST for each in numbers) and 0 <= self.kept <= 1):
            raise ValueError("a stretch must have a place of at most 1e6 m and a share of 0 to 1")


@dataclass(frozen=True)
class MapDiary:
    """What a map went through since its survey.

    Attributes
    ----------
    drives
        The survey and the drives, in order.
    changes
        Steel that came or went.
    faded
        Stretches whose earlier readings lost weight.
    """

    drives: tuple[MapDrive, ...]
    changes: tuple[DatedChange, ...] = ()
    faded: tuple[FadedStretch, ...] = ()

    def __post_init__(self) -> None:
        """Raise a ValueError for numbers of drives and changes that there are not."""
        numbers = [n for each in self.changes for n in (each.drive, each.before)]
        numbers += [each.drive for each in self.faded]
        others = [each.other for each in self.changes if each.other is not None]
        if not all(0 <= n < len(self.drives) for n in numbers):
            raise ValueError("a change or a stretch is of a drive that the map does not have")
        if not all(0 <= n < len(self.changes) for n in others):
            raise ValueError("a change belongs to one that the map does not have")


def words_of(diary: MapDiary, number: int) -> str:
    """Return what happened to the steel of a change, by its index, in a few words."""
    change = diary.changes[number]
    if change.went:
        goes = [k for k, each in enumerate(diary.changes) if taken_from(each) == number]
        how = f"moved to {goes[0] + 1}" if goes else "went"
        return how if change.other is None else f"{how} (was {change.other + 1})"
    return change.what.value if change.other is None else f"moved from {change.other + 1}"


def doubtful(diary: MapDiary) -> str | None:
    """Return what else steel that came may be; nothing where none did."""
    came = any(each.what is Happening.CAME and each.other is None for each in diary.changes)
    return HIDDEN if came else None


def taken_from(change: DatedChange) -> int | None:
    """Return the index of the change that took steel away which this one brought."""
    return None if change.went else change.other


def between(diary: MapDiary, number: int) -> str:
    """Return the days between which a change happened, by its index."""
    change = diary.changes[number]
    return f"{diary.drives[change.before].day} and {diary.drives[change.drive].day}"
