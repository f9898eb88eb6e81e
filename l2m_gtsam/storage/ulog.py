"""ULogs of PX4 as logs: each topic with the messages that PX4's bridge to ROS 2 would have."""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, make_dataclass
from io import StringIO
from keyword import iskeyword
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import IntArray
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bounded import opened
from l2m_gtsam.storage.field_types import PX4_TYPE
from l2m_gtsam.storage.log import TableLog, TableTopic
from l2m_gtsam.storage.messages import LATEST_US, PX4_POSE_TYPE

MAX_BYTES = 2_000_000_000
TOO_LARGE = f"{{}}: larger than {MAX_BYTES // 1_000_000} MB; give a shorter log"
MISSING = "ULogs need pyulog: install l2m-gtsam with its extra `px4`"
INDEXED = re.compile(r"^(.*)\[(\d+)\]$")
LOCAL_POSE = "/vehicle_local_pose"


@dataclass(frozen=True)
class _Topic:
    """A topic of a ULog: its name, that of the file, and its columns."""

    topic: str
    name: str
    columns: dict[str, np.ndarray[Any, Any]]

    @property
    def stamp_ns(self) -> IntArray:
        """When its messages were published in nanoseconds since the start of PX4."""
        return np.asarray(self.columns["timestamp"].astype(np.int64) * 1000)


def read_ulog(path: Path) -> TableLog:
    """Return a ULog as a log; poses of PX4's estimator stand in for odometry that is not there.

    Times are those since the start of PX4.

    Raises
    ------
    BagError
        The file is no ULog, is damaged or empty, or pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise BagError(f"{path}: {MISSING}") from error
    try:
        # It prints what it thinks of damaged logs, names of strangers among it.
        with opened(path, BagError) as file, redirect_stdout(StringIO()):
            if os.fstat(file.fileno()).st_size > MAX_BYTES:
                raise BagError(TOO_LARGE.format(path))
            parsed = ULog(file).data_list
    except BagError:
        raise
    except Exception as error:  # of a damaged file it raises whatever comes first
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise BagError(f"{path}: not a readable ULog ({reason})") from error
    several = Counter(each.name for each in parsed)
    topics = [
        _Topic(_topic_name(each.name, each.multi_id, several[each.name]), each.name, each.data)
        for each in parsed
        if len(each.data.get("timestamp", ()))
    ]
    if not topics:
        raise BagError(f"{path}: the log has no messages")
    if late := [each.topic for each in topics if each.columns["timestamp"].max() > LATEST_US]:
        raise BagError(f"{path}: damaged: times on {late[0]} are those of no log")
    channels = [_channel(each) for each in topics]
    if all(channel.msgtype != PX4_POSE_TYPE for channel in channels):
        channels.extend(_local_pose(topics))
    return TableLog(path, channels)


def _topic_name(name: str, index: int, count: int) -> str:
    return f"/{name}" if count == 1 else f"/{name}_{index}"


def _channel(topic: _Topic) -> TableTopic:
    names, groups = list[str](), defaultdict[str, dict[int, str]](dict)
    for column in topic.columns:
        element = INDEXED.match(column)
        name = re.sub(r"\W+", "_", element[1] if element else column, flags=re.ASCII).strip("_")
        if not name.isidentifier() or iskeyword(name):
            continue
        groups[name][int(element[2]) if element else -1] = column
        if name not in names:
            names.append(name)
    columns = [_values(topic, groups[name]) for name in names]
    message = make_dataclass("Px4Message", names)

    def contents() -> Iterator[Any]:
        return (message(*row) for row in zip(*columns, strict=True))

    return TableTopic(topic.topic, _type_of(topic), topic.stamp_ns, contents)


def _values(topic: _Topic, group: dict[int, str]) -> Sequence[Any]:
    """Return what a field has in each message: a number, or a list of an array's elements."""
    columns = [topic.columns[group[index]] for index in sorted(group)]
    rows = columns[0] if -1 in group else np.column_stack(columns)
    return list(rows.tolist())


def _type_of(topic: _Topic) -> str:
    """Return the type that PX4's bridge to ROS 2 gives a topic."""
    if topic.name.endswith("_odometry") and {"position[0]", "q[0]"} <= set(topic.columns):
        return PX4_POSE_TYPE
    if topic.name == "sensor_combined" and "magnetometer_ga[0]" in topic.columns:
        return PX4_TYPE  # where PX4 had the readings until 2018
    return "px4_msgs/msg/" + "".join(word.capitalize() for word in topic.name.split("_"))


def _local_pose(topics: Sequence[_Topic]) -> Iterator[TableTopic]:
    """Yield local positions with the attitudes between them, if both are there."""
    by_name = {each.name: each.columns for each in reversed(topics)}
    place, attitude = by_name.get("vehicle_local_position"), by_name.get("vehicle_attitude")
    if place is None or attitude is None:
        return
    if not {"x", "y", "z"} <= set(place) or "q[0]" not in attitude:
        return
    taken = _sampled(attitude)
    taken, first = np.unique(taken, return_index=True)
    q = np.column_stack([attitude[f"q[{k}]"] for k in (1, 2, 3, 0)])[first].astype(np.float64)
    sound = np.isfinite(q).all(axis=1) & (np.linalg.norm(q, axis=1) > 0.5)
    taken, q = taken[sound], q[sound]
    if len(taken) < 2:
        return
    stamps = _sampled(place)
    inside = (stamps >= taken[0]) & (stamps <= taken[-1])
    p = np.column_stack([place[axis] for axis in "xyz"])[inside].astype(np.float64)
    turned = Slerp(taken - taken[0], Rotation.from_quat(q))(stamps[inside] - taken[0])
    xyzw = turned.as_quat()
    rows = zip(stamps[inside].tolist(), p.tolist(), xyzw[:, [3, 0, 1, 2]].tolist(), strict=True)
    message = make_dataclass("Px4Message", ["timestamp", "position", "q"])
    poses = [message(*row) for row in rows]
    yield TableTopic(LOCAL_POSE, PX4_POSE_TYPE, 1000 * stamps[inside], lambda: iter(poses))


def _sampled(columns: dict[str, np.ndarray[Any, Any]]) -> IntArray:
    """Return when a topic's messages were measured in microseconds, shape (N,)."""
    sampled = columns.get("timestamp_sample")
    unknown = sampled is None or not sampled.all() or sampled.max() > LATEST_US
    taken = columns["timestamp"] if unknown or sampled is None else sampled
    return np.asarray(taken.astype(np.int64))
