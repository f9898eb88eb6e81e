"""Small bags of every kind for tests, written message by message with rosbags."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

KINDS = ("ros1", "sqlite3", "mcap")
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Ros:
    """Messages of one generation of ROS, by short names."""

    store: Typestore

    def __call__(self, name: str, **fields: Any) -> Any:
        """Return a message of the type ``package/Name``."""
        return self.store.types[name.replace("/", "/msg/")](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self(
            "builtin_interfaces/Time", sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS
        )
        seq = {"seq": 0} if self.counts_messages else {}
        return self("std_msgs/Header", **seq, stamp=stamp, frame_id=frame)

    @cached_property
    def counts_messages(self) -> bool:
        return "seq" in signature(self.store.types["std_msgs/msg/Header"]).parameters

    def vector(self, values: Iterable[float], name: str = "Vector3") -> Any:
        x, y, z = (float(v) for v in values)
        return self(f"geometry_msgs/{name}", x=x, y=y, z=z)

    def quaternion(self, values: Iterable[float]) -> Any:
        x, y, z, w = (float(v) for v in values)
        return self("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def magnetic(self, stamp_ns: int, tesla: Iterable[float], frame: str = "mag") -> Any:
        return self(
            "sensor_msgs/MagneticField",
            header=self.header(stamp_ns, frame),
            magnetic_field=self.vector(tesla),
            magnetic_field_covariance=np.zeros(9),
        )

    def pose(self, p: Iterable[float], q: Iterable[float]) -> Any:
        return self(
            "geometry_msgs/Pose", position=self.vector(p, "Point"), orientation=self.quaternion(q)
        )

    def pose_stamped(self, stamp_ns: int, p: Iterable[float], q: Iterable[float]) -> Any:
        return self(
            "geometry_msgs/PoseStamped", header=self.header(stamp_ns, "map"), pose=self.pose(p, q)
        )

    def transform(
        self, stamp_ns: int, parent: str, child: str, p: Iterable[float], q: Iterable[float]
    ) -> Any:
        return self(
            "geometry_msgs/TransformStamped",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=self(
                "geometry_msgs/Transform", translation=self.vector(p), rotation=self.quaternion(q)
            ),
        )


@dataclass(frozen=True)
class Entry:
    """A message with its topic, type (``package/Name``) and record time."""

    topic: str
    msgtype: str
    record_ns: int
    message: Any


def ros(kind: str) -> Ros:
    """Return the messages of a kind of bag."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":  # rosbags ships Noetic without tf2_msgs
        layout = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(layout, "tf2_msgs/msg/TFMessage"))
    return Ros(store)


def write(folder: Path, kind: str, entries: list[Entry], name: str = "bag") -> Path:
    """Write entries to ``folder`` and return the path of the bag."""
    dialect = ros(kind)
    path = folder / (f"{name}.bag" if kind == "ros1" else name)
    writer: Any
    if kind == "ros1":
        writer = Ros1Writer(path)
        serialize = dialect.store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Ros2Writer(path, version=9, storage_plugin=plugin)
        serialize = dialect.store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for entry in entries:
            full = entry.msgtype.replace("/", "/msg/")
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, full, typestore=dialect.store
                )
            writer.write(connections[entry.topic], entry.record_ns, serialize(entry.message, full))
    return path
