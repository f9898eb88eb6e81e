"""Scans of a lidar out of a bag, one by one."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.errors import BagError
from l2m_gtsam.records.scans import Scan, ScanOptions
from l2m_gtsam.storage.bag_options import Stamps
from l2m_gtsam.storage.messages import header_ns
from l2m_gtsam.storage.open_bag import Progress, open_bag
from l2m_gtsam.storage.point_cloud2 import CLOUD_TYPE, chosen_cloud_topic, points_of, times_of


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
    progress: Progress | None = None

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
                stamp = message.record_ns if self.stamps is Stamps.RECORD else header_ns(content)
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
