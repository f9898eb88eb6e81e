"""What was recorded: poses, readings and numbers of a drive, and where they came from."""

from dataclasses import dataclass

from l2m_gtsam.data.arrays import FloatArray, IntArray
from l2m_gtsam.data.poses import Trajectory
from l2m_gtsam.data.tables import TimedTable

ARRAYS = "(arrays)"  # in place of the path of what was made of arrays, not read from a file


@dataclass(frozen=True)
class FieldSeries(TimedTable):
    """What one magnetometer reported, in its own frame and in order of time.

    Attributes
    ----------
    sensor
        Name of the sensor, unique within a recording.
    topic, frame
        Where it came from.
    stamp_ns
        Times in nanoseconds, ascending; a stamp may be repeated, shape (N,).
    field
        Magnetic field in microtesla, shape (N, 3); NaN marks a missing axis.
    """

    sensor: str
    topic: str
    frame: str
    stamp_ns: IntArray
    field: FloatArray


@dataclass(frozen=True)
class ScalarSeries(TimedTable):
    """A number that was recorded along a drive: a motor's current, a speed, a duty cycle.

    Attributes
    ----------
    name
        What it is called, unique within a recording.
    topic
        Where it came from.
    stamp_ns
        Times in nanoseconds, strictly increasing, shape (M,).
    value
        Finite, in the unit of the topic times the scale that was asked for, shape (M,).
    """

    name: str
    topic: str
    stamp_ns: IntArray
    value: FloatArray


@dataclass(frozen=True)
class SourceFile:
    """Where data came from: a file or folder and the SHA-256 of its content."""

    path: str
    sha256: str


def same_content(one: SourceFile | None, other: SourceFile | None) -> bool:
    """Return whether both are there and have the same content, wherever they lie."""
    return one is not None and other is not None and one.sha256 == other.sha256


@dataclass(frozen=True)
class Recording:
    """One drive, or several joined by ``joining.joined``.

    Attributes
    ----------
    trajectory
        The lidar's poses in the map.
    series
        Readings of every magnetometer.
    source
        Where it came from.
    scalars
        Numbers that were recorded.
    drives
        What it was joined from, each in its own time, in order of time; empty for one drive.
    moved_ns
        What was added to the stamps of each drive so that none overlaps another, nanoseconds.
    notes
        What is worth a warning, a sentence each: where its poses come from if the bag has none, or
        several topics with some, or a clock that was set.
    origins
        What else it was made from, a sentence each with the hash of the file.
    poses
        The file with its poses; absent where they are in the source.
    """

    trajectory: Trajectory
    series: tuple[FieldSeries, ...]
    source: SourceFile
    scalars: tuple[ScalarSeries, ...] = ()
    drives: tuple["Recording", ...] = ()
    moved_ns: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    origins: tuple[str, ...] = ()
    poses: SourceFile | None = None

    @property
    def parts(self) -> tuple["Recording", ...]:
        """Its drives; itself if it is one."""
        return self.drives or (self,)
