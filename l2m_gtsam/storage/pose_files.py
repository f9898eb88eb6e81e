"""Poses from files of their own: TUM, KITTI with a file of times, CSV with named columns."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import ColumnOptions, PoseFileOptions
from l2m_gtsam.storage.csv_log import read_table
from l2m_gtsam.storage.files import open_text
from l2m_gtsam.storage.units import odd_poses

NANOSECONDS = 1_000_000_000
COLUMNS, KITTI_COLUMNS = 8, 12
LATEST_S = 9_000_000_000  # nanoseconds after it do not fit into 64 bits
NO_TUM = (
    "; expected in a line: stamp x y z qx qy qz qw, blanks between; put # before names of columns, "
    "call a table with commas .csv"
)
ROUNDED = 1e-2  # of a rotation matrix: KITTI's have seven digits, those of others often four


def read_poses(path: Path, options: PoseFileOptions) -> Trajectory:
    """Return the poses of a file of any kind, in order of time and the first of each stamp.

    Parameters
    ----------
    path
        TUM or KITTI, distinguished by their columns, or ``.csv``.
    options
        Times for KITTI, columns of CSV, and what is added to the times.

    Raises
    ------
    BagError
        A file is missing or of no such format; the line of it is named.
    """
    if path.suffix.lower() == ".csv":
        found = read_csv_poses(path, options.columns)
    elif is_kitti(path):
        if options.times is None:
            raise BagError(
                f"{path}: has the poses of KITTI, which hold no times; give a file with a time in "
                "seconds for each, `--pose-times`"
            )
        found = read_kitti(path, options.times)
    else:
        found = read_tum(path)
    return replace(found, stamp_ns=found.stamp_ns + round(options.offset_s * NANOSECONDS))


def read_csv_poses(path: Path, options: ColumnOptions) -> Trajectory:
    """Return the poses of a table; rows with an empty cell are left out.

    Raises
    ------
    BagError
        The file is missing, is no table or has no poses.
    """
    table = read_table(path, options)
    position, orientation = table.roles.position, table.roles.orientation
    if position is None or orientation is None:
        what = "position" if position is None else "orientation (a quaternion)"
        raise BagError(
            f"{path}: no columns of the {what} are known by their names, as x, y, z, qx, qy, qz, "
            "qw; name them with `bag.pose_file.columns`"
        )
    p, q = table.rows(position), table.rows(orientation)
    kept = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
    return poses_of(path, table.stamp_ns[kept], p[kept], q[kept])


def read_tum(path: Path) -> Trajectory:
    """Return the poses of a file, in order of time and the first of each stamp.

    Parameters
    ----------
    path
        Lines of ``stamp x y z qx qy qz qw``; empty ones and those after a ``#`` are skipped.

    Raises
    ------
    BagError
        The file is missing or not of this format; the line of it is named.
    """
    stamps, rows = list[int](), list[list[float]]()
    for number, words in _lines(path):
        with _at_line(path, number):
            stamps.append(_seconds(words[0], NO_TUM))
            rows.append(_pose(words))
    poses = np.array(rows).reshape(-1, COLUMNS - 1)
    return poses_of(path, np.array(stamps, dtype=np.int64), poses[:, :3], poses[:, 3:])


def read_kitti(path: Path, times: Path) -> Trajectory:
    """Return the poses of a file of KITTI, in order of time and the first of each stamp.

    Parameters
    ----------
    path
        Lines of twelve numbers: the first three rows of a pose's matrix, one after the other.
    times
        A time in seconds for each pose, a line each.

    Raises
    ------
    BagError
        A file is missing or not of this format, or they differ in length.
    """
    rows = list[list[float]]()
    for number, words in _lines(path):
        with _at_line(path, number):
            rows.append(_matrix(words))
    stamps = list[int]()
    for number, words in _lines(times):
        with _at_line(times, number):
            if len(words) != 1:
                raise ValueError(f"{len(words)} columns; expected: a time in seconds")
            stamps.append(_seconds(words[0]))
    if len(stamps) != len(rows):
        raise BagError(f"{path} has {len(rows)} poses, {times} has {len(stamps)} times")
    matrices = np.array(rows).reshape(-1, 3, 4)
    with _at_line(path, 1):
        quaternions = Rotation.from_matrix(matrices[:, :, :3]).as_quat()
    return poses_of(path, np.array(stamps, dtype=np.int64), matrices[:, :, 3], quaternions)


def is_kitti(path: Path) -> bool:
    """Return whether the first line of a file has the numbers of KITTI; a BagError if none has."""
    for _, words in _lines(path):
        return len(words) == KITTI_COLUMNS
    raise BagError(f"{path}: holds no poses; expected: stamp x y z qx qy qz qw")


def poses_of(
    path: Path, stamp_ns: IntArray, p: FloatArray, quaternion_xyzw: FloatArray
) -> Trajectory:
    """Return the poses that a file has, in order of time and the first of each stamp.

    Raises
    ------
    BagError
        There are fewer than two, or one of them is out of range.
    """
    if len(stamp_ns) < 2:
        raise BagError(f"{path}: holds {len(stamp_ns)} poses; two or more are needed")
    stamps, first = np.unique(stamp_ns, return_index=True)
    if wrong := odd_poses(p[first], quaternion_xyzw[first]):
        raise BagError(f"{path}: {wrong}")
    R = Rotation.from_quat(quaternion_xyzw[first]).as_matrix()
    return Trajectory(stamps, R, p[first], "map", "lidar")


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the words of each line that has any, with its number."""
    with open_text(path, BagError) as file:
        for number, line in enumerate(file, start=1):
            if words := line.split("#", 1)[0].split():
                yield number, words


@contextmanager
def _at_line(path: Path, number: int) -> Iterator[None]:
    """Say on which line of a file something is wrong."""
    try:
        yield
    except ValueError as error:
        raise BagError(f"{path}: line {number}: {error}") from error


def _seconds(word: str, expected: str = "") -> int:
    """Return seconds, as text, in nanoseconds; a ValueError with what is expected if not."""
    try:
        seconds = Decimal(word)
    except InvalidOperation:
        raise ValueError(f"{word[:40]!r} is no time in seconds{expected}") from None
    if not (seconds.is_finite() and 0 <= seconds < LATEST_S):
        raise ValueError(f"{word[:40]!r} is no time in seconds since 1970")
    return round(seconds * NANOSECONDS)


def _pose(words: list[str]) -> list[float]:
    """Return position and rotation of a line; ValueError if they are none."""
    if len(words) != COLUMNS:
        raise ValueError(f"{len(words)} columns; expected: stamp x y z qx qy qz qw")
    values = [float(word) for word in words[1:]]
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    pose = np.array(values)
    if wrong := odd_poses(pose[None, :3], pose[None, 3:]):
        raise ValueError(wrong)
    return values


def _matrix(words: list[str]) -> list[float]:
    """Return the twelve numbers of a line; ValueError if they are no pose."""
    if len(words) != KITTI_COLUMNS:
        raise ValueError(f"{len(words)} columns; expected: the 12 numbers of a pose's matrix")
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    R = np.array(values).reshape(3, 4)[:, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > ROUNDED or np.linalg.det(R) < 0:
        raise ValueError("the matrix holds no rotation")
    return values
