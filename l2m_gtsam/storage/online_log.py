"""Localisations on line in files: their log, JSON lines with poses and events, and saved states.

Lines are appended and flushed, so that what was written before a kill stays; a line that was cut
short is left out when the log is read.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import MapState, Trajectory
from l2m_gtsam.errors import ConfigError, MapError
from l2m_gtsam.storage.bounded import open_regular
from l2m_gtsam.storage.files import unwritten
from l2m_gtsam.storage.map_file import load_map, save_map

MOST_LINE = 10_000  # characters
POSE_FIELDS = {"R": (3, 3), "p": (3,), "covariance": (6, 6)}


@dataclass(frozen=True)
class LogLine:
    """A line: either a pose or an event, with its time.

    Attributes
    ----------
    stamp_ns
        Time in nanoseconds.
    pose
        R, p and covariance of a key pose as nested lists, by name; None for an event.
    event
        Kind and text; None for a pose.
    """

    stamp_ns: int
    pose: dict[str, list[object]] | None = None
    event: tuple[str, str] | None = None

    def text(self) -> str:
        """Return the line."""
        own: dict[str, object] = {"stamp_ns": self.stamp_ns}
        if self.event is not None:
            return json.dumps(own | {"event": self.event[0], "text": self.event[1]})
        return json.dumps(own | dict(self.pose or {}))


class OnlineLog:
    """Appends lines to a log.

    Raises
    ------
    OutputError
        The file cannot be written.
    """

    def __init__(self, path: Path, kept: Sequence[LogLine]) -> None:
        self._path = path
        try:
            self._file: TextIO = path.open("w", encoding="utf-8")
        except OSError as error:
            raise unwritten(path, error) from error
        self.add(kept)

    def add(self, lines: Sequence[LogLine]) -> None:
        """Append lines, and have them on their way to the disk."""
        try:
            self._file.writelines(f"{each.text()}\n" for each in lines)
            self._file.flush()
        except OSError as error:
            raise unwritten(self._path, error) from error

    def __enter__(self) -> "OnlineLog":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_log(path: Path) -> tuple[LogLine, ...]:
    """Return the lines of a log.

    Raises
    ------
    ConfigError
        There is no such file, or it is no log.
    """
    try:
        with TextIOWrapper(open_regular(path), encoding="utf-8") as file:
            return tuple(_lines(path, file))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a log that can be read; begin without --resume") from error


def _lines(path: Path, file: TextIO) -> Iterator[LogLine]:
    while line := file.readline(MOST_LINE):
        if not line.endswith("\n"):  # the process was killed here
            return
        try:
            own = json.loads(line)
            stamp = int(own.pop("stamp_ns"))
            if "event" in own:
                yield LogLine(stamp, event=(str(own["event"]), str(own["text"])))
                continue
            pose = {name: own[name] for name in POSE_FIELDS}
            sound = all(np.shape(pose[name]) == shape for name, shape in POSE_FIELDS.items())
            if not sound or not all(np.isfinite(each).all() for each in pose.values()):
                raise ValueError
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise ConfigError(f"{path}: not a log of `l2m slam --online`, or damaged") from error
        yield LogLine(stamp, pose=pose)


def logged_trajectory(lines: Sequence[LogLine]) -> Trajectory:
    """Return the poses of a log, the last of those with one stamp."""
    poses = {each.stamp_ns: each.pose for each in lines if each.pose is not None}
    stamps = sorted(poses)
    own = {
        name: np.reshape([poses[stamp][name] for stamp in stamps], (-1, *shape))
        for name, shape in POSE_FIELDS.items()
    }
    return Trajectory(
        np.array(stamps, dtype=np.int64), own["R"], own["p"], "map", "lidar", own["covariance"]
    )


KIND = "online-state"
VERSION = 4


@dataclass(frozen=True)
class SavedState:
    """A state.

    Attributes
    ----------
    arrays
        Numeric arrays by name.
    facts
        Plain values.
    """

    arrays: dict[str, npt.NDArray[Any]]
    facts: dict[str, Any]


def write_state(path: Path, state: SavedState) -> None:
    """Write a state under a temporary name and rename it.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    arrays = {name: np.asarray(array) for name, array in state.arrays.items()}
    save_map(path, MapState(KIND, arrays, state.facts, {"version": VERSION}))


def read_state(path: Path) -> SavedState:
    """Return a state.

    Raises
    ------
    ConfigError
        There is no such file, it is something else, or it is damaged.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; begin without --resume")
    try:
        found = load_map(path)
    except MapError as error:
        raise ConfigError(damaged(path)) from error
    if found.kind != KIND or found.provenance != {"version": VERSION}:
        raise ConfigError(damaged(path))
    return SavedState(found.arrays, found.options)


def damaged(path: Path) -> str:
    """Return that a file is no state."""
    return (
        f"{path}: not a state that this version of `l2m slam --online` saved, or damaged; begin "
        "without --resume"
    )
