"""Messages of ROS 1 and 2 out of what a simulation measured."""

from collections.abc import Callable
from dataclasses import dataclass
from inspect import signature
from typing import Any, Protocol

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, FloatArray, IntArray, Trajectory
from l2m_gtsam.pose_covariance import to_ros
from l2m_gtsam.scans import Scan

NANOSECONDS = 1_000_000_000
TESLA_PER_MICROTESLA = 1e-6
ODOMETRY = "nav_msgs/msg/Odometry"
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
FLOAT32 = 7  # of PointField


class Scans(Protocol):
    """Scans of a drive, made one by one."""

    @property
    def stamp_ns(self) -> IntArray:
        """When they begin, shape (N,)."""

    def __getitem__(self, index: int, /) -> Scan: ...


@dataclass(frozen=True)
class Dialect:
    """How one generation of ROS spells messages."""

    store: Typestore
    serialize: Callable[[object, str], bytes | memoryview]

    def make(self, name: str, /, **fields: Any) -> Any:
        """Return a message of this type."""
        return self.store.types[name](**fields)

    def header(self, index: int, stamp_ns: int, frame: str) -> Any:
        """Return a header; only ROS1 counts messages in it."""
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        Header = self.store.types["std_msgs/msg/Header"]
        counter = {"seq": index} if "seq" in signature(Header).parameters else {}
        return Header(**counter, stamp=stamp, frame_id=frame)

    def pose(self, p: FloatArray, quaternion: FloatArray) -> Any:
        """Return a pose; the quaternion is x, y, z, w."""
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **_named("xyz", p)),
            orientation=self.make("geometry_msgs/msg/Quaternion", **_named("xyzw", quaternion)),
        )

    def vector(self, values: FloatArray) -> Any:
        """Return a vector of three values."""
        return self.make("geometry_msgs/msg/Vector3", **_named("xyz", values))


@dataclass(frozen=True)
class Channel:
    """The messages of one topic: their stamps, and how to make the k-th."""

    topic: str
    msgtype: str
    stamp_ns: IntArray
    message: Callable[[int], Any]


def ros1() -> Dialect:
    """Return the spelling of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    return Dialect(store, store.serialize_ros1)


def ros2() -> Dialect:
    """Return the spelling of ROS 2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    return Dialect(store, store.serialize_cdr)


def odometry(dialect: Dialect, trajectory: Trajectory, topic: str) -> Channel:
    """Return poses as odometry whose twist is unknown (all zero)."""
    quaternions = Rotation.from_matrix(trajectory.R).as_quat()
    stamps = trajectory.stamp_ns.tolist()
    covariance = _stated(trajectory)
    none = dialect.vector(np.zeros(3))
    twist = dialect.make("geometry_msgs/msg/Twist", linear=none, angular=none)
    twist_with_covariance = dialect.make(
        "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
    )

    def message(index: int) -> Any:
        pose = dialect.pose(trajectory.p[index], quaternions[index])
        return dialect.make(
            ODOMETRY,
            header=dialect.header(index, stamps[index], trajectory.frame),
            child_frame_id=trajectory.child_frame,
            pose=dialect.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance[index]
            ),
            twist=twist_with_covariance,
        )

    return Channel(topic, ODOMETRY, trajectory.stamp_ns, message)


def _stated(trajectory: Trajectory) -> FloatArray:
    """Return the covariances as messages hold them, all zero where unknown, shape (N, 36)."""
    if trajectory.covariance is None:
        return np.broadcast_to(np.zeros(36), (len(trajectory), 36))
    return to_ros(trajectory.covariance, trajectory.R).reshape(-1, 36)


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


def point_clouds(dialect: Dialect, scans: Scans, frame: str, topic: str) -> Channel:
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


def _named(names: str, values: FloatArray) -> dict[str, float]:
    """Return values by single-letter names."""
    return dict(zip(names, values.tolist(), strict=True))
