"""Trajectories as text in the format of TUM, and as ROS 2 has them: ``trajectory.mcap``."""

import tempfile
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.ros_messages import odometry_channel, ros2, transform_channel, write_channels

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


TOPIC = "/odometry/localised"
ODOM = "odom"  # REP-105


@dataclass(frozen=True)
class LocalisedMotion:
    """A drive that was localised.

    Attributes
    ----------
    localised
        Key poses in the map, with the covariance of each.
    twist
        Angular (rad/s), then linear velocity (m/s) at them along the axes of the lidar, (K, 6).
    odometry
        Poses as they were recorded, in a frame of their own; those of the key poses among them.
    """

    localised: Trajectory
    twist: FloatArray
    odometry: Trajectory


def write_trajectory_bag(path: Path, motion: LocalisedMotion) -> None:
    """Write odometry at key poses, and transforms map -> odom -> lidar (REP-105).

    The last is odometry as it was recorded, the first what the localisation makes of it at key
    poses.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    dialect, odometry = ros2(), own_frame(motion)
    channels = [
        odometry_channel(dialect, TOPIC, motion.localised, motion.twist),
        transform_channel(dialect, (map_odom(motion.localised, odometry), odometry)),
    ]
    stamps = np.concatenate([channel.stamp_ns for channel in channels])
    with (
        atomic_path(path) as temporary,
        tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder,
    ):
        bag = Path(folder) / path.stem  # rosbag2 makes a folder, and repeats its name inside
        with Ros2Writer(bag, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            write_channels(writer, dialect, channels, stamps)
        (bag / f"{bag.name}.mcap").replace(temporary)


def own_frame(motion: LocalisedMotion) -> Trajectory:
    """Return odometry in a frame that is not the map's: names of tf are unique."""
    localised, name = motion.localised, motion.odometry.frame.lstrip("/")
    taken = ("", localised.frame, localised.child_frame)
    frame = ODOM if name in taken else name
    return replace(motion.odometry, frame=frame, child_frame=localised.child_frame)


def map_odom(localised: Trajectory, odometry: Trajectory) -> Trajectory:
    """Return the frame of odometry in the map at key poses."""
    rows = np.searchsorted(odometry.stamp_ns, localised.stamp_ns)
    R = localised.R @ odometry.R[rows].transpose(0, 2, 1)
    p = localised.p - np.einsum("nij,nj->ni", R, odometry.p[rows])
    return Trajectory(localised.stamp_ns, R, p, localised.frame, odometry.frame)
