"""Trajectories as text that evo, and most other programs, read: the format of TUM."""

from pathlib import Path

from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Trajectory
from l2m_gtsam.storage.atomic import atomic_path

HEADER = "# stamp (s)  x y z (m)  qx qy qz qw: the lidar in the map\n"
NANOSECONDS = 1_000_000_000


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
