"""Trajectories as text that evo, and most other programs, read: the format of TUM."""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.atomic import atomic_path

HEADER = "# stamp (s)  x y z (m)  qx qy qz qw: the lidar in the map\n"
NANOSECONDS = 1_000_000_000
COLUMNS = 8
LATEST_S = 9_000_000_000  # nanoseconds after it do not fit into 64 bits
MAX_BYTES = 500_000_000  # a day at 50 Hz


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write poses, a line each; stamps to the nanosecond, positions to the nanometre.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(tum_text(trajectory), encoding="utf-8")


def tum_text(trajectory: Trajectory) -> str:
    """Return poses as text."""
    quaternions = Rotation.from_matrix(trajectory.R).as_quat()
    lines = [HEADER]
    for stamp, p, q in zip(trajectory.stamp_ns.tolist(), trajectory.p, quaternions, strict=True):
        # In integers: a double cannot hold today's nanoseconds.
        seconds = f"{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}"
        numbers = " ".join(f"{value:.9f}" for value in (*p, *q))
        lines.append(f"{seconds} {numbers}\n")
    return "".join(lines)


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
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BagError(f"{path}: larger than {MAX_BYTES // 1_000_000} MB; give a shorter one")
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise BagError(f"{path}: no such file; a trajectory in TUM's format is expected") from error
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise BagError(f"{path}: cannot be read: {reason}") from error
    stamps, rows = [], []
    for number, line in enumerate(lines, start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            stamps.append(_nanoseconds(words[0]))
            rows.append(_pose(words))
        except ValueError as error:
            raise BagError(f"{path}: line {number}: {error}") from error
    if len(stamps) < 2:
        raise BagError(f"{path}: holds {len(stamps)} poses; two or more are needed")
    stamp_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
    poses = np.array(rows)[first]
    R = Rotation.from_quat(poses[:, 3:]).as_matrix()
    return Trajectory(stamp_ns, R, poses[:, :3], "map", "lidar")


def _nanoseconds(word: str) -> int:
    """Return seconds, as text, in nanoseconds; ValueError if they are none."""
    try:
        seconds = Decimal(word)
    except InvalidOperation:
        raise ValueError(f"{word[:40]!r} is no time in seconds") from None
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
    if np.linalg.norm(values[3:]) < 1e-6:
        raise ValueError("the quaternion is all zero, it must be a rotation")
    return values
