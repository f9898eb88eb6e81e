"""ROS messages as they are written: headers, odometry, transforms, and topics into a bag."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.geometry import to_ros

NANOSECONDS = 1_000_000_000
ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class Dialect:
    """How one generation of ROS spells messages, and whether it counts them in their headers."""

    store: Typestore
    serialize: Callable[[object, str], bytes | memoryview]
    counts: bool

    def make(self, name: str, /, **fields: Any) -> Any:
        """Return a message of this type."""
        return self.store.types[name](**fields)

    def header(self, index: int, stamp_ns: int, frame: str) -> Any:
        """Return a header; only ROS1 counts messages in it."""
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        counter = {"seq": index} if self.counts else {}
        return self.make("std_msgs/msg/Header", **counter, stamp=stamp, frame_id=frame)

    def vector(self, values: FloatArray) -> Any:
        """Return a vector of three values."""
        return self.make("geometry_msgs/msg/Vector3", **named("xyz", values))

    def pose(self, p: FloatArray, quaternion: FloatArray) -> Any:
        """Return a pose; the quaternion is x, y, z, w."""
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **named("xyz", p)),
            orientation=self.quaternion(quaternion),
        )

    def quaternion(self, values: FloatArray) -> Any:
        """Return a rotation from x, y, z, w."""
        return self.make("geometry_msgs/msg/Quaternion", **named("xyzw", values))


@dataclass(frozen=True)
class Channel:
    """The messages of one topic: their stamps, and how to make the k-th."""

    topic: str
    msgtype: str
    stamp_ns: IntArray
    message: Callable[[int], Any]


def ros1() -> Dialect:
    """Return how ROS 1 spells messages."""
    store = get_typestore(Stores.ROS1_NOETIC)
    return Dialect(store, store.serialize_ros1, counts=True)


def ros2() -> Dialect:
    """Return how ROS 2 does, as of Humble and later."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    return Dialect(store, store.serialize_cdr, counts=False)


def odometry_channel(
    dialect: Dialect, topic: str, trajectory: Trajectory, twist: FloatArray | None = None
) -> Channel:
    """Return poses as odometry; covariances are all zero where they are unknown.

    Parameters
    ----------
    dialect
        Generation of ROS.
    topic
        Name of the topic.
    trajectory
        N poses.
    twist
        Angular (rad/s), then linear velocity (m/s) along the axes of the body, shape (N, 6); all
        zero if not given. Its covariance is unknown.
    """
    quaternions = Rotation.from_matrix(trajectory.R).as_quat()
    stamps, covariance = trajectory.stamp_ns.tolist(), _stated(trajectory)
    velocity = np.zeros((len(trajectory), 6)) if twist is None else twist

    def message(k: int) -> Any:
        pose = dialect.pose(trajectory.p[k], quaternions[k])
        return dialect.make(
            ODOMETRY,
            header=dialect.header(k, stamps[k], trajectory.frame),
            child_frame_id=trajectory.child_frame,
            pose=dialect.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance[k]
            ),
            twist=_twist(dialect, velocity[k]),
        )

    return Channel(topic, ODOMETRY, trajectory.stamp_ns, message)


def transform_channel(dialect: Dialect, trajectories: Sequence[Trajectory]) -> Channel:
    """Return poses of several bodies as transforms on ``/tf``, one a message, in order of time."""
    stamps = np.concatenate([each.stamp_ns for each in trajectories])
    owner = np.repeat(np.arange(len(trajectories)), [len(each) for each in trajectories])
    row = np.concatenate([np.arange(len(each)) for each in trajectories])
    quaternions = [Rotation.from_matrix(each.R).as_quat() for each in trajectories]
    order = np.argsort(stamps, kind="stable")
    owner, row, stamps = owner[order], row[order], stamps[order]

    def message(k: int) -> Any:
        trajectory, at = trajectories[owner[k]], row[k]
        transform = dialect.make(
            "geometry_msgs/msg/Transform",
            translation=dialect.vector(trajectory.p[at]),
            rotation=dialect.quaternion(quaternions[owner[k]][at]),
        )
        stamped = dialect.make(
            "geometry_msgs/msg/TransformStamped",
            header=dialect.header(k, int(stamps[k]), trajectory.frame),
            child_frame_id=trajectory.child_frame,
            transform=transform,
        )
        return dialect.make(TF_MESSAGE, transforms=[stamped])

    return Channel("/tf", TF_MESSAGE, stamps, message)


def write_channels(
    writer: Ros1Writer | Ros2Writer,
    dialect: Dialect,
    channels: Sequence[Channel],
    record_ns: IntArray,
) -> None:
    """Write all messages in the order in which they were recorded.

    Parameters
    ----------
    writer
        An open bag.
    dialect
        Of its generation of ROS.
    channels
        Its topics.
    record_ns
        When each message was recorded, channel by channel.
    """
    connections: list[Connection] = [
        writer.add_connection(channel.topic, channel.msgtype, typestore=dialect.store)
        for channel in channels
    ]
    counts = [len(channel.stamp_ns) for channel in channels]
    source = np.repeat(np.arange(len(channels)), counts)
    index = np.concatenate([np.arange(count) for count in counts])
    for n in np.argsort(record_ns, kind="stable").tolist():
        channel = channels[source[n]]
        data = dialect.serialize(channel.message(int(index[n])), channel.msgtype)
        writer.write(connections[source[n]], int(record_ns[n]), data)


def named(names: str, values: FloatArray) -> dict[str, float]:
    """Return values by single-letter names."""
    return dict(zip(names, values.tolist(), strict=True))


def _twist(dialect: Dialect, velocity: FloatArray) -> Any:
    twist = dialect.make(
        "geometry_msgs/msg/Twist",
        linear=dialect.vector(velocity[3:]),
        angular=dialect.vector(velocity[:3]),
    )
    return dialect.make(
        "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
    )


def _stated(trajectory: Trajectory) -> FloatArray:
    """Return the covariances as messages hold them, all zero where unknown, shape (N, 36)."""
    if trajectory.covariance is None:
        return np.broadcast_to(np.zeros(36), (len(trajectory), 36))
    return to_ros(trajectory.covariance, trajectory.R).reshape(-1, 36)
