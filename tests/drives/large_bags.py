"""Bags as vehicles record them: what a calibration needs, between images and clouds."""

from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

WIDTH, HEIGHT = 1920, 1080
POINTS = 65_536
PAIR = 3 * WIDTH * HEIGHT + 16 * POINTS  # bytes of an image and a cloud
IMAGE, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2"
Message = tuple[int, str, str, bytes]


def write_among_images(path: Path, drive: Path, size: int) -> Path:
    """Write a drive again with as many images as clouds, as an mcap file of about a size.

    Parameters
    ----------
    path
        Folder of the bag.
    drive
        A bag of ROS 2; what it holds is taken over as it is.
    size
        Bytes. Images and clouds are evenly spaced over the drive.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    with (
        AnyReader([drive]) as reader,
        Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        known = {
            each.topic: writer.add_connection(each.topic, each.msgtype, typestore=store)
            for each in reader.connections
        }
        for topic, msgtype in (("/camera/image_raw", IMAGE), ("/lidar/points", CLOUD)):
            known[topic] = writer.add_connection(topic, msgtype, typestore=store)
        drives = (
            (stamp, connection.topic, connection.msgtype, raw)
            for connection, stamp, raw in reader.messages()
        )
        for stamp, topic, _, raw in merge(
            drives, _pictures(store, reader.start_time, reader.duration, size)
        ):
            writer.write(known[topic], stamp, raw)
    return path


def _pictures(store: Any, start_ns: int, duration_ns: int, size: int) -> Iterator[Message]:
    """Yield images and clouds of so many bytes, no two images alike."""
    random, count = np.random.default_rng(0), size // PAIR
    pixels = random.integers(0, 256, 3 * WIDTH * HEIGHT, dtype=np.uint8)
    points = random.normal(size=(POINTS, 4)).astype(np.float32)
    for k in range(count):
        stamp = start_ns + duration_ns * k // count
        made = (
            ("/camera/image_raw", IMAGE, _image(store, stamp, np.roll(pixels, k))),
            ("/lidar/points", CLOUD, _cloud(store, stamp, points)),
        )
        for topic, msgtype, message in made:
            yield stamp, topic, msgtype, bytes(store.serialize_cdr(message, msgtype))


def _header(store: Any, stamp_ns: int, frame: str) -> Any:
    types = store.types
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _image(store: Any, stamp_ns: int, pixels: Any) -> Any:
    return store.types[IMAGE](
        header=_header(store, stamp_ns, "camera"),
        height=HEIGHT,
        width=WIDTH,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * WIDTH,
        data=pixels,
    )


def _cloud(store: Any, stamp_ns: int, points: Any) -> Any:
    make = store.types["sensor_msgs/msg/PointField"]
    names = ("x", "y", "z", "intensity")
    return store.types[CLOUD](
        header=_header(store, stamp_ns, "lidar"),
        height=1,
        width=POINTS,
        fields=[make(name=each, offset=4 * k, datatype=7, count=1) for k, each in enumerate(names)],
        is_bigendian=False,
        point_step=16,
        row_step=16 * POINTS,
        data=points.view(np.uint8).ravel(),
        is_dense=True,
    )
