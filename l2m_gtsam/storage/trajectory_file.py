"""Trajectories as TUM text: one line of ``stamp x y z qx qy qz qw`` per pose.

Seconds, metres, unit quaternions; lines that begin with ``#`` are comments. The format is that of
the TUM RGB-D benchmark (Sturm et al., IROS 2012), which evo and others read.
"""

from array import array
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import IntArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.atomic import atomic_path

NANOSECONDS = 1_000_000_000
COLUMNS = 8
# Far beyond any calendar, and safe in 64-bit nanoseconds.
MAX_SECONDS = 9_000_000_000


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; stamps keep their nanoseconds and numbers all their digits.

    Parameters
    ----------
    path
        File to write.
    trajectory
        Poses of the child frame in the reference frame; the file states both in a comment only.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    quaternions = Rotation.from_matrix(trajectory.R).as_quat(canonical=True)
    numbers = np.hstack([trajectory.p, quaternions]).tolist()
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f"# {trajectory.child_frame} in {trajectory.frame}\n")
        file.write("# stamp x y z qx qy qz qw\n")
        for stamp, row in zip(_seconds(trajectory.stamp_ns), numbers, strict=True):
            file.write(" ".join([stamp, *map(repr, row)]) + "\n")


def read_tum(path: Path, frame: str = "map", child_frame: str = "lidar") -> Trajectory:
    """Return the trajectory in a TUM file, in order of time, the first of equal stamps only.

    Parameters
    ----------
    path
        The file.
    frame, child_frame
        Names of the frames, which the format does not carry.

    Raises
    ------
    BagError
        The file is missing or a line is not a pose; the message names the line.
    """
    stamps, numbers = array("q"), array("d")
    try:
        with path.open(encoding="utf-8") as file:
            for count, line in enumerate(file, 1):
                if (text := line.strip()) and not text.startswith("#"):
                    stamp, row = _parse_line(f"{path}, line {count}", text)
                    stamps.append(stamp)
                    numbers.extend(row)
    except (OSError, UnicodeDecodeError) as error:
        missing = isinstance(error, FileNotFoundError)
        msg = f"{path}: {'no such file' if missing else 'cannot be read as text'}"
        raise BagError(msg) from error
    unique, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
    rows = np.array(numbers).reshape(-1, COLUMNS - 1)[first]
    R = Rotation.from_quat(rows[:, 3:]).as_matrix()
    return Trajectory(unique, R, rows[:, :3], frame, child_frame)


def _seconds(stamp_ns: IntArray) -> list[str]:
    """Return stamps as exact decimal seconds, which no float could hold."""
    sign = ["-" if stamp < 0 else "" for stamp in stamp_ns.tolist()]
    parts = [divmod(abs(stamp), NANOSECONDS) for stamp in stamp_ns.tolist()]
    return [f"{s}{whole}.{rest:09d}" for s, (whole, rest) in zip(sign, parts, strict=True)]


def _parse_line(where: str, text: str) -> tuple[int, list[float]]:
    parts = text.split()
    try:
        stamp, row = Decimal(parts[0]), [float(part) for part in parts[1:]]
    except (InvalidOperation, ValueError) as error:
        msg = f"{where}: not a pose; accepted: stamp x y z qx qy qz qw, separated by spaces"
        raise BagError(msg) from error
    fits = len(parts) == COLUMNS and stamp.is_finite() and abs(stamp) < MAX_SECONDS
    if not fits or not np.isfinite(row).all() or not any(row[3:]):
        msg = f"{where}: not a pose; accepted: eight finite numbers, the last four not all zero"
        raise BagError(msg)
    return int((stamp * NANOSECONDS).to_integral_value()), row
