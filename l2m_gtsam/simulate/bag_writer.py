"""Simulated recordings as real bags."""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, FloatArray, IntArray, Recording, Trajectory
from l2m_gtsam.errors import OutputError
from l2m_gtsam.options import Options
from l2m_gtsam.pose_covariance import to_ros
from l2m_gtsam.simulate.sensors import NoiseOptions

NANOSECONDS = 1_000_000_000
TESLA_PER_MICROTESLA = 1e-6
ODOMETRY = "nav_msgs/msg/Odometry"
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"


class BagKind(StrEnum):
    """The three containers in which ROS keeps recordings."""

    ROS1 = "ros1"
    SQLITE3 = "sqlite3"
    MCAP = "mcap"


class BagOptions(Options):
    """What a bag says beside poses and readings."""

    odometry_topic: str = "/odometry"
    """Topic of the poses."""
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
    path: Path, kind: BagKind, recording: Recording, options: BagOptions | None = None
) -> None:
    """Write a recording as a bag: odometry, and one topic of readings in tesla per sensor.

    Header stamps are the recording's, record stamps come a latency later, and messages stand in
    order of record stamps. The bag appears under its name when it is complete, or not at all; a
    bag that was there before is replaced then.

    Parameters
    ----------
    path
        File (ROS1, ending in ``.bag``) or folder (others).
    kind
        Container to write.
    recording
        Poses and readings.
    options
        What the bag says beside these.

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
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as parent:
            unfinished = Path(parent) / path.name
            _write(unfinished, kind, recording, options or BagOptions())
            if path.is_dir():  # a folder that is not empty cannot be renamed over
                path.rename(Path(parent) / "replaced")
            unfinished.rename(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error


def _is_replaceable(path: Path, kind: BagKind) -> bool:
    """Return whether a path holds what this writer writes for this kind, and nothing else."""
    if kind is BagKind.ROS1:
        return path.is_file()
    suffix = ".mcap" if kind is BagKind.MCAP else ".db3"
    ours = {"metadata.yaml", path.name + suffix}
    return path.is_dir() and {entry.name for entry in path.iterdir()} == ours


@dataclass(frozen=True)
class _Dialect:
    """How one generation of ROS spells messages."""

    store: Typestore
    serialize: Callable[[object, str], bytes | memoryview]

    def make(self, name: str, **fields: Any) -> Any:
        """Return a message of this type."""
        return self.store.types[name](**fields)

    def header(self, index: int, stamp_ns: int, frame: str) -> Any:
        """Return a header; only ROS1 counts messages in it."""
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        Header = self.store.types["std_msgs/msg/Header"]
        counter = {"seq": index} if "seq" in signature(Header).parameters else {}
        return Header(**counter, stamp=stamp, frame_id=frame)

    def vector(self, values: FloatArray) -> Any:
        """Return a vector of three values."""
        return self.make("geometry_msgs/msg/Vector3", **_named("xyz", values))


@dataclass(frozen=True)
class _Channel:
    """The messages of one topic: their stamps, and how to make the k-th."""

    topic: str
    msgtype: str
    stamp_ns: IntArray
    message: Callable[[int], Any]


def _ros1() -> _Dialect:
    store = get_typestore(Stores.ROS1_NOETIC)
    return _Dialect(store, store.serialize_ros1)


def _ros2() -> _Dialect:
    store = get_typestore(Stores.ROS2_HUMBLE)
    return _Dialect(store, store.serialize_cdr)


def _write(path: Path, kind: BagKind, recording: Recording, options: BagOptions) -> None:
    """Write all messages to a bag at this path."""
    dialect = _ros1() if kind is BagKind.ROS1 else _ros2()
    channels = [
        _odometry(dialect, recording.trajectory, options),
        *(_magnetic_field(dialect, series, options.noise) for series in recording.series),
    ]
    with _writer(path, kind) as writer:
        connections: list[Connection] = [
            writer.add_connection(channel.topic, channel.msgtype, typestore=dialect.store)
            for channel in channels
        ]
        for record_ns, source, index in _in_record_order(channels, options):
            channel = channels[source]
            data = dialect.serialize(channel.message(index), channel.msgtype)
            writer.write(connections[source], record_ns, data)


def _writer(path: Path, kind: BagKind) -> Ros1Writer | Ros2Writer:
    """Return the writer of this container."""
    if kind is BagKind.ROS1:
        return Ros1Writer(path)
    plugin = StoragePlugin.MCAP if kind is BagKind.MCAP else StoragePlugin.SQLITE3
    return Ros2Writer(path, version=8, storage_plugin=plugin)  # 8: read by humble and later


def _in_record_order(
    channels: list[_Channel], options: BagOptions
) -> Iterator[tuple[int, int, int]]:
    """Return (record stamp, channel, index of the message in it) in order of time."""
    rng = np.random.default_rng(options.seed)
    counts = [len(channel.stamp_ns) for channel in channels]
    source = np.repeat(np.arange(len(channels)), counts)
    index = np.concatenate([np.arange(count) for count in counts])
    stamps = np.concatenate([channel.stamp_ns for channel in channels])
    delay = options.latency + rng.exponential(options.latency_spread, len(stamps))
    record_ns = stamps + np.round(delay * NANOSECONDS).astype(np.int64)
    order = np.argsort(record_ns, kind="stable")
    return zip(
        record_ns[order].tolist(), source[order].tolist(), index[order].tolist(), strict=True
    )


def _odometry(dialect: _Dialect, trajectory: Trajectory, options: BagOptions) -> _Channel:
    """Return the poses as odometry whose twist is unknown (all zero)."""
    quaternions = Rotation.from_matrix(trajectory.R).as_quat()
    stamps = trajectory.stamp_ns.tolist()
    covariance = _stated(trajectory)
    none = dialect.vector(np.zeros(3))
    twist = dialect.make("geometry_msgs/msg/Twist", linear=none, angular=none)
    twist_with_covariance = dialect.make(
        "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
    )

    def message(index: int) -> Any:
        pose = dialect.make(
            "geometry_msgs/msg/Pose",
            position=dialect.make("geometry_msgs/msg/Point", **_named("xyz", trajectory.p[index])),
            orientation=dialect.make(
                "geometry_msgs/msg/Quaternion", **_named("xyzw", quaternions[index])
            ),
        )
        return dialect.make(
            ODOMETRY,
            header=dialect.header(index, stamps[index], trajectory.frame),
            child_frame_id=trajectory.child_frame,
            pose=dialect.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance[index]
            ),
            twist=twist_with_covariance,
        )

    return _Channel(options.odometry_topic, ODOMETRY, trajectory.stamp_ns, message)


def _stated(trajectory: Trajectory) -> FloatArray:
    """Return the covariances as messages hold them, all zero where unknown, shape (N, 36)."""
    if trajectory.covariance is None:
        return np.broadcast_to(np.zeros(36), (len(trajectory), 36))
    return to_ros(trajectory.covariance, trajectory.R).reshape(-1, 36)


def _magnetic_field(dialect: _Dialect, series: FieldSeries, noise: NoiseOptions) -> _Channel:
    """Return the readings of one sensor in tesla."""
    field = series.field * TESLA_PER_MICROTESLA
    stamps = series.stamp_ns.tolist()
    covariance = np.eye(3).ravel() * (noise.field * TESLA_PER_MICROTESLA) ** 2

    def message(index: int) -> Any:
        return dialect.make(
            MAGNETIC_FIELD,
            header=dialect.header(index, stamps[index], series.frame),
            magnetic_field=dialect.vector(field[index]),
            magnetic_field_covariance=covariance,
        )

    return _Channel(series.topic, MAGNETIC_FIELD, series.stamp_ns, message)


def _named(names: str, values: FloatArray) -> dict[str, float]:
    """Return values by single-letter names."""
    return dict(zip(names, values.tolist(), strict=True))
