"""PointCloud2: topics that carry it, points and their times as arrays, and scans one by one."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Connection

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Count
from l2m_gtsam.records.scans import Scan, ScanOptions
from l2m_gtsam.storage.bag_options import Stamps
from l2m_gtsam.storage.open_bag import Bag, open_bag
from l2m_gtsam.storage.open_log import is_table
from l2m_gtsam.storage.point_table import stacked
from l2m_gtsam.storage.selection import listed

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
FLOATS = {7: "f4", 8: "f8"}  # PointField.FLOAT32 and FLOAT64
INTEGERS = {5: "i4", 6: "u4"}  # PointField.INT32 and UINT32
# What drivers call the time of a point.
TIME_FIELDS = ("time", "t", "timestamp", "time_stamp", "offset_time")
# Numbers above these are times since 1970, in seconds and in nanoseconds.
EPOCH_S, EPOCH_NS = 1e8, 1e17
MOST_POINTS = 10_000_000  # of one scan
# A turn of a lidar is shorter: times further from the stamp are something else.
LONGEST_S = 1.0


def cloud_connections(bag: Bag, topic: str) -> list[Connection]:
    """Return the connections of a topic of clouds; its leading slash does not matter.

    Raises
    ------
    BagError
        There is no such topic, or it is of another type.
    """
    named = [c for c in bag.connections if c.topic.lstrip("/") == topic.lstrip("/")]
    clouds = [c for c in bag.connections if c.msgtype == CLOUD_TYPE]
    if not named:
        raise BagError(f"{bag.path}: no topic {topic!r}; with clouds there are: {listed(clouds)}")
    if wrong := [c for c in named if c.msgtype != CLOUD_TYPE]:
        raise BagError(
            f"{bag.path}: topic {topic} is of type {wrong[0].msgtype}, a cloud must be "
            f"{CLOUD_TYPE}; of that type there are: {listed(clouds)}"
        )
    return named


def chosen_cloud_topic(bag: Bag, topic: str | None) -> list[Connection]:
    """Return the connections of a topic of clouds, of the only one if none is named.

    Raises
    ------
    BagError
        There is no such topic, or there are several to choose from.
    """
    if topic is not None:
        return cloud_connections(bag, topic)
    clouds = [c for c in bag.connections if c.msgtype == CLOUD_TYPE]
    topics = sorted({c.topic for c in clouds})
    if not topics:
        raise BagError(
            f"{bag.path}: no topic of type {CLOUD_TYPE}; there are: {listed(bag.connections)}"
        )
    if len(topics) > 1:
        raise BagError(
            f"{bag.path}: several topics carry point clouds, choose one with `lidar.topic`: "
            f"{', '.join(topics)}"
        )
    return clouds


def points_of(scan: Any) -> FloatArray:
    """Return x, y and z of a PointCloud2 as written, shape (N, 3).

    Raises
    ------
    ValueError
        The scan declares what its data does not hold, or has no x, y and z.
    """
    if not scan.height * scan.width:
        return np.zeros((0, 3))
    return stacked([_column(scan, *_coordinate(scan, axis)) for axis in "xyz"])


def times_of(scan: Any, stamp_ns: int) -> FloatArray | None:
    """Return when each point of a PointCloud2 was measured, in seconds after a stamp, shape (N,).

    Fields that drivers write are understood: whole numbers are nanoseconds, others seconds, since
    the stamp or since 1970 (then also nanoseconds). None if there is no such field, or the times
    are more than a second from the stamp.

    Raises
    ------
    ValueError
        The scan declares what its data does not hold.
    """
    fields = {each.name: each for each in scan.fields if each.name in TIME_FIELDS}
    for name in TIME_FIELDS:
        kind = {**FLOATS, **INTEGERS}.get(fields[name].datatype) if name in fields else None
        if kind is None or not scan.height * scan.width:
            continue
        values = _column(scan, _inside(scan, name, int(fields[name].offset), kind), kind)
        seconds = _since(values.astype(np.float64), kind, stamp_ns)
        known = seconds[np.isfinite(seconds)]
        return seconds if len(known) and np.abs(known).max() <= LONGEST_S else None
    return None


def _since(values: FloatArray, kind: str, stamp_ns: int) -> FloatArray:
    """Return times in seconds after a stamp."""
    if kind in INTEGERS.values():
        return 1e-9 * values
    largest = np.nanmax(np.abs(values), initial=0.0)
    if largest > EPOCH_NS:
        return 1e-9 * (values - stamp_ns)
    return values - 1e-9 * stamp_ns if largest > EPOCH_S else values


def _column(scan: Any, offset: int, kind: str) -> npt.NDArray[Any]:
    """Return a field of all points, shape (N,)."""
    height, width, step = int(scan.height), int(scan.width), int(scan.point_step)
    row = int(scan.row_step) if height > 1 else width * step
    if row < width * step or (height - 1) * row + width * step > len(scan.data):
        raise ValueError(
            f"a scan declares {height} x {width} points of {step} bytes in rows of {row} bytes, "
            f"which its {len(scan.data)} bytes are not"
        )
    if height * width > MOST_POINTS:
        raise ValueError(f"a scan has {height * width:,} points, at most {MOST_POINTS:,}")
    order = ">" if scan.is_bigendian else "<"
    return np.ndarray((height, width), order + kind, scan.data, offset, (row, step)).ravel()


def _coordinate(scan: Any, name: str) -> tuple[int, str]:
    """Return where a coordinate begins in a point, in bytes, and its type."""
    found = [each for each in scan.fields if each.name == name]
    if not found or found[0].datatype not in FLOATS or found[0].count > 1:
        names = ", ".join(each.name for each in scan.fields[:20]) or "(none)"
        raise ValueError(f"a scan has no field {name!r} of one float; its fields are: {names}")
    kind = FLOATS[found[0].datatype]
    return _inside(scan, name, int(found[0].offset), kind), kind


def _inside(scan: Any, name: str, offset: int, kind: str) -> int:
    """Return where a field begins, if it ends within a point."""
    if offset + np.dtype(kind).itemsize > scan.point_step:
        raise ValueError(f"a scan's field {name!r} reaches over the end of a point")
    return offset


@dataclass(frozen=True)
class ScanTopic:
    """The scans of a bag, read anew whenever they are asked for, one in memory at a time.

    Attributes
    ----------
    path
        The bag.
    topic
        Of type sensor_msgs/PointCloud2; the only one if None.
    options
        What is taken of each.
    stamps
        Which time of a scan counts.
    progress
        Called with the messages read and their number.
    """

    path: Path
    topic: str | None
    options: ScanOptions
    stamps: Stamps = Stamps.HEADER
    progress: Count | None = None

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans in order of time; one that is not later than all before is left out.

        Raises
        ------
        BagError
            The bag, the topic or a scan is not usable.
        """
        latest, frame = None, None
        with open_bag(self.path) as bag:
            for message in bag.messages(chosen_cloud_topic(bag, self.topic), self.progress):
                content, where = message.content, f"{self.path}: topic {message.connection.topic}"
                stamp = message.stamp_ns(self.stamps)
                if frame not in (None, content.header.frame_id):
                    raise BagError(
                        f"{where}: has scans in several frames ({frame}, "
                        f"{content.header.frame_id}); record one topic per lidar"
                    )
                frame = content.header.frame_id
                if latest is None or stamp > latest:
                    latest = stamp
                    yield _scan(content, stamp, self.options, where)


def has_clouds(path: Path) -> bool:
    """Return whether a bag has any topic of point clouds.

    Raises
    ------
    BagError
        The bag cannot be opened.
    """
    if is_table(path):
        return False
    with open_bag(path) as bag:
        return any(connection.msgtype == CLOUD_TYPE for connection in bag.connections)


def cloud_topic(path: Path, topic: str | None) -> str:
    """Return the topic of a bag's clouds, the only one if none is named.

    Raises
    ------
    BagError
        There is no such topic, or there are several.
    """
    with open_bag(path) as bag:
        return chosen_cloud_topic(bag, topic)[0].topic


def _scan(content: Any, stamp_ns: int, options: ScanOptions, where: str) -> Scan:
    try:
        points, times = points_of(content), times_of(content, stamp_ns)
    except ValueError as error:
        raise BagError(f"{where}: {error}") from error
    kept = _in_range(points, options)
    if times is None:
        return Scan(stamp_ns, points[kept])
    kept &= np.isfinite(times)
    return Scan(stamp_ns, points[kept], times[kept])


def _in_range(points: FloatArray, options: ScanOptions) -> BoolArray:
    """Return which points are finite and at a useful distance, shape (N,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.sqrt(np.einsum("ni,ni->n", points, points))
        return np.asarray((distance >= options.min_range) & (distance <= options.max_range))
