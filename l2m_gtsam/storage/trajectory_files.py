"""Trajectories written as text in TUM's format, and as ROS 2 has them: ``trajectory.mcap``."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.storage.files import atomic_path, write_text
from l2m_gtsam.storage.parts import part_folder
from l2m_gtsam.storage.ros_messages import odometry_channel, ros2, transform_channel, write_channels

HEADER = "# stamp (s)  x y z (m)  qx qy qz qw: the lidar in the map\n"
NANOSECONDS = 1_000_000_000


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write poses, a line each; stamps to the nanosecond, positions to the nanometre.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    write_text(path, tum_text(trajectory))


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
    with atomic_path(path) as temporary, part_folder(path) as folder:
        bag = folder / path.stem  # rosbag2 makes a folder, and repeats its name inside
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
