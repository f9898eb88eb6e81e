"""Scans of a lidar as messages of a bag, in any layout."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from l2m_gtsam.data import FloatArray
from tests.drives.bags import Entry, ros

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
TYPE = "sensor_msgs/PointCloud2"


def field(name: str, offset: int = 0, datatype: int = 7, count: int = 1, kind: str = "mcap") -> Any:
    make = ros(kind).store.types["sensor_msgs/msg/PointField"]
    return make(name=name, offset=offset, datatype=datatype, count=count)


@dataclass(frozen=True)
class Layout:
    """How the bytes of a scan are laid out."""

    kind: str = "<f4"
    lead: int = 0
    tail: int = 0
    rows: int = 1
    row_tail: int = 0
    names: str = "xyz"

    def fields(self, kind: str) -> list[Any]:
        size = np.dtype(self.kind).itemsize
        datatype = {4: 7, 8: 8}[size]
        return [
            field(name, self.lead + k * size, datatype, kind=kind)
            for k, name in enumerate(self.names)
        ]

    def data(self, points: FloatArray) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], int, int]:
        """Return the bytes, the size of a point and that of a row; padding is not zero."""
        columns = ["xyz".index(name) for name in self.names]
        numbers = np.ascontiguousarray(points[:, columns], dtype=self.kind)
        body = numbers.view(np.uint8).reshape(len(points), -1)
        pad = [np.full((len(points), width), 0xA5, np.uint8) for width in (self.lead, self.tail)]
        step = self.lead + body.shape[1] + self.tail
        rows = np.hstack([pad[0], body, pad[1]]).reshape(self.rows, -1)
        rows = np.hstack([rows, np.full((self.rows, self.row_tail), 0x5A, np.uint8)])
        return rows.ravel(), step, rows.shape[1]


PLAIN = Layout()


def scan(
    kind: str, stamp_ns: int, points: FloatArray, layout: Layout = PLAIN, **changes: Any
) -> Any:
    make = ros(kind)
    data, step, row = layout.data(points)
    parts = {
        "header": make.header(stamp_ns, "lidar"),
        "height": layout.rows,
        "width": len(points) // layout.rows,
        "fields": layout.fields(kind),
        "is_bigendian": layout.kind.startswith(">"),
        "point_step": step,
        "row_step": row,
        "data": data,
        "is_dense": False,
    }
    return make(TYPE, **{**parts, **changes})


def entries(scans: Iterable[Any], topic: str = "/points") -> list[Entry]:
    """Scans in a bag that received each 20 ms after its stamp."""
    found = []
    for each in scans:
        stamp = each.header.stamp.sec * SECOND + each.header.stamp.nanosec
        found.append(Entry(topic, TYPE, stamp + SECOND // 50, each))
    return found
