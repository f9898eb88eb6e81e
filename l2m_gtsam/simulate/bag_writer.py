"""Simulated recordings as real bags."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, IntArray, Recording, Trajectory
from l2m_gtsam.errors import OutputError
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.lidar import SimulatedScans
from l2m_gtsam.simulate.sensors import NoiseOptions
from l2m_gtsam.storage.files import unwritten
from l2m_gtsam.storage.parts import part_folder
from l2m_gtsam.storage.ros_messages import (
    NANOSECONDS,
    Channel,
    Dialect,
    odometry_channel,
    ros1,
    ros2,
    write_channels,
)

TESLA_PER_MICROTESLA = 1e-6
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
FLOAT32 = 7  # of PointField


def magnetic_field(dialect: Dialect, series: FieldSeries, noise: float) -> Channel:
    """Return the readings of one sensor in tesla, whose noise is given in microtesla."""
    field = series.field * TESLA_PER_MICROTESLA
    stamps = series.stamp_ns.tolist()
    covariance = np.eye(3).ravel() * (noise * TESLA_PER_MICROTESLA) ** 2

    def message(index: int) -> Any:
        return dialect.make(
            MAGNETIC_FIELD,
            header=dialect.header(index, stamps[index], series.frame),
            magnetic_field=dialect.vector(field[index]),
            magnetic_field_covariance=covariance,
        )

    return Channel(series.topic, MAGNETIC_FIELD, series.stamp_ns, message)


def poses(dialect: Dialect, trajectory: Trajectory, topic: str) -> Channel:
    """Return poses alone."""
    quaternions = Rotation.from_matrix(trajectory.R).as_quat()
    stamps = trajectory.stamp_ns.tolist()

    def message(index: int) -> Any:
        return dialect.make(
            POSE_STAMPED,
            header=dialect.header(index, stamps[index], trajectory.frame),
            pose=dialect.pose(trajectory.p[index], quaternions[index]),
        )

    return Channel(topic, POSE_STAMPED, trajectory.stamp_ns, message)


def point_clouds(dialect: Dialect, scans: SimulatedScans, frame: str, topic: str) -> Channel:
    """Return scans in single precision: x, y, z, and the seconds since the stamp if it has them."""

    def message(index: int) -> Any:
        scan = scans[index]
        columns = scan.points if scan.time_s is None else np.c_[scan.points, scan.time_s]
        names = ("x", "y", "z", "time")[: columns.shape[1]]
        fields = [
            dialect.make(
                "sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=FLOAT32, count=1
            )
            for k, name in enumerate(names)
        ]
        return dialect.make(
            POINT_CLOUD,
            header=dialect.header(index, scan.stamp_ns, frame),
            height=1,
            width=len(scan),
            fields=fields,
            is_bigendian=False,
            point_step=4 * len(names),
            row_step=4 * len(names) * len(scan),
            data=np.ascontiguousarray(columns, dtype="<f4").view(np.uint8).ravel(),
            is_dense=True,
        )

    return Channel(topic, POINT_CLOUD, scans.stamp_ns, message)


class BagKind(StrEnum):
    """The three containers in which ROS keeps recordings."""

    ROS1 = "ros1"
    SQLITE3 = "sqlite3"
    MCAP = "mcap"


class WriterOptions(Options):
    """Topics, latencies and stated noise of a bag."""

    odometry_topic: str = "/odometry"
    """Topic of the poses."""
    points_topic: str = "/points"
    """Topic of the scans, if there are any."""
    truth_topic: str = "/ground_truth"
    """Topic of the true poses, if they are written."""
    latency: Annotated[float, Field(ge=0)] = 0.003
    """Least time from measurement to record in seconds."""
    latency_spread: Annotated[float, Field(ge=0)] = 0.001
    """Mean of the random time that is added to it in seconds (exponential)."""
    noise: NoiseOptions = NoiseOptions()
    """Of it, the standard deviation that the readings' covariances state; poses bring their
    own."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the latencies."""


def write_bag(
    path: Path,
    kind: BagKind,
    recording: Recording,
    options: WriterOptions | None = None,
    *,
    scans: SimulatedScans | None = None,
    truth: Trajectory | None = None,
) -> None:
    """Write a recording as a bag: odometry, and one topic of readings in tesla per sensor.

    Header stamps are the recording's, record stamps come a latency later, and messages stand in
    order of record stamps. The bag appears under its name when it is complete, or not at all; a
    bag that was there before is replaced then.

    Parameters
    ----------
    path
        File (ROS1, ending in ``.bag``) or folder (others).
    options
        Topics, latencies and stated noise.
    scans
        Point clouds in the lidar frame, made one by one as they are written.
    truth
        True poses. They are no odometry but ``PoseStamped``, so that a reader that looks for poses
        by type takes those of the recording.

    Raises
    ------
    OutputError
        The path has the wrong suffix, is something other than a bag of this kind, or cannot be
        written.
    """
    if kind is BagKind.ROS1 and path.suffix != ".bag":
        raise OutputError(f"{path}: the name of a ROS1 bag must end in .bag")
    if path.exists() and not _is_replaceable(path, kind):
        raise OutputError(f"{path} exists and is no {kind} bag; choose another name")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # rosbag2 repeats the folder's name inside, so the name is right and its parent temporary.
        with part_folder(path) as parent:
            unfinished = parent / path.name
            _write(unfinished, kind, recording, options or WriterOptions(), scans, truth)
            if path.is_dir():  # a folder that is not empty cannot be renamed over
                path.rename(parent / "replaced")
            unfinished.rename(path)
    except OSError as error:
        raise unwritten(path, error) from error


def _is_replaceable(path: Path, kind: BagKind) -> bool:
    """Return whether a path holds what this writer writes for this kind, and nothing else."""
    if kind is BagKind.ROS1:
        return path.is_file()
    suffix = ".mcap" if kind is BagKind.MCAP else ".db3"
    ours = {"metadata.yaml", path.name + suffix}
    return path.is_dir() and {entry.name for entry in path.iterdir()} == ours


def _write(
    path: Path,
    kind: BagKind,
    recording: Recording,
    options: WriterOptions,
    scans: SimulatedScans | None,
    truth: Trajectory | None,
) -> None:
    """Write all messages to a bag at this path."""
    dialect = ros1() if kind is BagKind.ROS1 else ros2()
    noise = options.noise.field
    channels = [
        odometry_channel(dialect, options.odometry_topic, recording.trajectory),
        *(magnetic_field(dialect, series, noise) for series in recording.series),
    ]
    # Last, so that the latencies of the others do not depend on them.
    if scans is not None:
        frame = recording.trajectory.child_frame
        channels.append(point_clouds(dialect, scans, frame, options.points_topic))
    if truth is not None:
        channels.append(poses(dialect, truth, options.truth_topic))
    with _writer(path, kind) as writer:
        write_channels(writer, dialect, channels, _record_ns(channels, options))


def _writer(path: Path, kind: BagKind) -> Ros1Writer | Ros2Writer:
    """Return the writer of this container."""
    if kind is BagKind.ROS1:
        return Ros1Writer(path)
    plugin = StoragePlugin.MCAP if kind is BagKind.MCAP else StoragePlugin.SQLITE3
    return Ros2Writer(path, version=8, storage_plugin=plugin)  # 8: read by humble and later


def _record_ns(channels: list[Channel], options: WriterOptions) -> IntArray:
    """Return when messages were recorded, channel by channel."""
    rng = np.random.default_rng(options.seed)
    stamps = np.concatenate([channel.stamp_ns for channel in channels])
    delay = options.latency + rng.exponential(options.latency_spread, len(stamps))
    return np.asarray(stamps + np.round(delay * NANOSECONDS).astype(np.int64))
