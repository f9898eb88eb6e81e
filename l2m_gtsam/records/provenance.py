"""Where a result came from: files, when drives were recorded, what a map was made of."""

from dataclasses import dataclass
from datetime import UTC, datetime

from l2m_gtsam.data import SourceFile
from l2m_gtsam.records.map_diary import UNDATED, MapDrive
from l2m_gtsam.records.record import Record

# The years 2000 to 2100: clocks that were never set begin in 1970.
CREDIBLE_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9
DAY_S = 86_400.0


@dataclass(frozen=True)
class NamedSource(Record):
    """A file that took part: what it was, its path and the SHA-256 of its content."""

    role: str
    path: str
    sha256: str


@dataclass(frozen=True)
class RecordedDrive(Record):
    """When a drive was recorded, and which frames its poses are of.

    Attributes
    ----------
    when
        First and last pose; undated where its clock was never set.
    frame, child_frame
        Names of the frames of the map and of the body whose poses were read.
    poses
        The file with its poses; absent where they are in the bag.
    """

    when: MapDrive
    frame: str
    child_frame: str
    poses: SourceFile | None = None


@dataclass(frozen=True)
class DriveTrace(Record):
    """Some poses of a drive, spread evenly over it.

    Attributes
    ----------
    stamp_ns
        Times in nanoseconds, strictly increasing, shape (N,).
    p
        Positions of the lidar in the map in metres, shape (N, 3).
    """

    stamp_ns: tuple[int, ...]
    p: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class MapOrigin(Record):
    """What a map was made from.

    Attributes
    ----------
    surveyed
        When: first and last pose of its survey.
    updated
        When the last drive ended that it was given since; absent where there is none.
    sources
        Bags, suites and clouds, as its file names them.
    """

    surveyed: MapDrive
    updated: str | None = None
    sources: tuple[NamedSource, ...] = ()

    def age_days(self, drive: MapDrive) -> float | None:
        """Return how old the map was when a drive began, in days; None where it is not known.

        It is as old as the last drive that it was given. A map of later than the drive has a
        negative age.
        """
        last = self.updated or self.surveyed.ended
        if last is None or drive.begun is None:
            return None
        try:
            age = datetime.fromisoformat(drive.begun) - datetime.fromisoformat(last)
        except ValueError:  # a file of others may name a 31st of February
            return None
        return age.total_seconds() / DAY_S


def in_utc(stamp_ns: int) -> str:
    """Return a stamp in nanoseconds as ISO date and time, to the second."""
    return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def dated(begun_ns: int, ended_ns: int) -> MapDrive:
    """Return when a drive was, by its first and last pose; undated if these are no dates."""
    if begun_ns < CREDIBLE_NS[0] or ended_ns > CREDIBLE_NS[1]:
        return UNDATED
    return MapDrive(in_utc(begun_ns), in_utc(ended_ns))
