"""Say what is in a bag, and what would be used of it and why."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import L2MError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag_options import (
    MICROTESLA_PER,
    BagOptions,
    Stamps,
    Strength,
    fault,
    is_turning,
    strength,
)
from l2m_gtsam.storage.messages import (
    FIELD_TYPE,
    POSE_TYPES,
    TF_TYPES,
    CovarianceBuffer,
    FieldBuffer,
    StampBuffer,
    header_ns,
)
from l2m_gtsam.storage.open_bag import Bag, open_bag
from l2m_gtsam.storage.point_cloud2 import CLOUD_TYPE
from l2m_gtsam.storage.selection import select_fields, select_poses, several_frames

BY_CLOUDS = "a map made with `l2m map build --lidar` gives poses to its point clouds"


@dataclass(frozen=True)
class TopicReport:
    """What is known of one topic.

    Attributes
    ----------
    topic, msgtype
        Name and type.
    frames
        Frames of its headers; empty where messages were not decoded.
    count
        Messages.
    rate_hz
        One over the median time between header stamps; of topics that are not decoded, messages
        over the time of the bag.
    longest_gap_s
        Longest time between messages.
    span_s
        First and last header stamp in seconds.
    clock_offset_s
        Median of record time less header stamp in seconds.
    nan_share
        Share of readings with a NaN axis; NaN for other types.
    strength
        |B| in uT, for magnetic fields.
    use
        What would be used of it, and why, or why not.
    """

    topic: str
    msgtype: str
    frames: tuple[str, ...]
    count: int
    rate_hz: float
    longest_gap_s: float
    span_s: tuple[float, float]
    clock_offset_s: float
    nan_share: float
    strength: Strength | None
    use: str


@dataclass(frozen=True)
class BagReport:
    """What is in a bag: its topics, and what prevents its use, if anything."""

    path: Path
    topics: tuple[TopicReport, ...]
    obstacles: tuple[str, ...]


@dataclass
class _TopicBuffers:
    stamps: StampBuffer = field(default_factory=StampBuffer)
    frames: set[str] = field(default_factory=set)
    readings: FieldBuffer = field(default_factory=lambda: FieldBuffer("", ""))
    covariances: CovarianceBuffer = field(default_factory=CovarianceBuffer)


def inspect_bag(path: Path, options: BagOptions, progress: Count | None = None) -> BagReport:
    """Look at every topic; only those that could be used are decoded.

    Parameters
    ----------
    path
        Bag of any kind.
    options
        What a calibration would read.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        The bag cannot be opened or read.
    """
    with open_bag(path) as bag:
        fields, no_fields = _selected(select_fields, bag, options)
        poses, no_poses = _selected(select_poses, bag, options)
        usable = [c for c in bag.connections if _is_usable(c)]
        collected: dict[str, _TopicBuffers] = {}
        for message in bag.messages(usable, progress):
            into = collected.setdefault(message.connection.topic, _TopicBuffers())
            _collect(into, message.content, message.connection.msgtype, message.record_ns)
        uses = {c.topic: "magnetic readings" for c in fields}
        uses |= {c.topic: f"poses ({_why_poses(options)})" for c in poses}
        topics, duration = _by_topic(bag), max(bag.duration_s, 1e-9)
        reports = [
            _report(topic, connections, collected.get(topic), uses.get(topic), duration, options)
            for topic, connections in topics.items()
        ]
    if no_poses and any(report.msgtype == CLOUD_TYPE for report in reports):
        no_poses = f"{no_poses}; {BY_CLOUDS}"
    obstacles = [reason for reason in (no_fields, no_poses) if reason]
    obstacles += [
        f"{r.topic}: {r.use}" for r in reports if r.use.startswith("refused") and r.topic in uses
    ]
    fields_used = [r for r in reports if r.topic in uses and r.strength is not None]
    if fields_used and not any(r.strength.readings for r in fields_used if r.strength):
        obstacles.append("no finite reading in any of the magnetic topics")
    # a static transform holds from any time on
    used = [r for r in reports if r.topic in uses and "tf_static" not in r.topic]
    return BagReport(path, tuple(reports), (*obstacles, *_clock_obstacles(used, options)))


def _clock_obstacles(used: list[TopicReport], options: BagOptions) -> list[str]:
    """Return what is wrong with the header stamps of the topics that would be used."""
    if options.stamps is Stamps.RECORD:
        return []
    advice = "use the record time with `bag.stamps: record`"
    found = [
        f"{r.topic}: all header stamps are 0; {advice}" for r in used if r.span_s == (0.0, 0.0)
    ]
    moving = [r for r in used if np.isfinite(r.span_s[0]) and r.span_s[1] > 0]
    latest_start = max(moving, key=lambda r: r.span_s[0], default=None)
    earliest_end = min(moving, key=lambda r: r.span_s[1], default=None)
    if latest_start and earliest_end and latest_start.span_s[0] > earliest_end.span_s[1]:
        found.append(
            f"{latest_start.topic} starts at {latest_start.span_s[0]:.3f} s, after "
            f"{earliest_end.topic} ends at {earliest_end.span_s[1]:.3f} s; if their clocks differ, "
            f"{advice}"
        )
    return found


def _selected(select: Any, bag: Bag, options: BagOptions) -> tuple[list[Connection], str]:
    """Return what a selection chooses, or why it cannot."""
    try:
        return select(bag, options), ""
    except L2MError as error:
        return [], str(error)


def _is_usable(connection: Connection) -> bool:
    return connection.msgtype in (FIELD_TYPE, *POSE_TYPES, *TF_TYPES)


def _why_poses(options: BagOptions) -> str:
    if options.tf is not None:
        return f"chain {options.tf.frame} to {options.tf.child_frame}"
    return "named by bag.poses" if options.poses is not None else "the only topic of its kind"


def _by_topic(bag: Bag) -> dict[str, list[Connection]]:
    topics: dict[str, list[Connection]] = {}
    for connection in sorted(bag.connections, key=lambda c: c.topic):
        topics.setdefault(connection.topic, []).append(connection)
    return topics


def _collect(into: _TopicBuffers, content: Any, msgtype: str, record_ns: int) -> None:
    for stamped in content.transforms if msgtype in TF_TYPES else (content,):
        into.stamps.add(header_ns(stamped), record_ns)
        into.frames.add(stamped.header.frame_id)
    if msgtype == FIELD_TYPE:
        into.readings.add(record_ns, content.magnetic_field)
    if msgtype in POSE_TYPES and (pose := POSE_TYPES[msgtype](content)).covariance is not None:
        into.covariances.add(pose.covariance)


def _report(
    topic: str,
    connections: list[Connection],
    found: _TopicBuffers | None,
    use: str | None,
    duration_s: float,
    options: BagOptions,
) -> TopicReport:
    msgtype = connections[0].msgtype
    found = found or _TopicBuffers()
    if use and len(found.covariances.row):
        use = f"{use}, {found.covariances.account()}"
    header, record = found.stamps.header(), found.stamps.record()
    gaps = np.diff(np.unique(header)).astype(np.float64) * 1e-9
    count = sum(c.msgcount for c in connections)
    values = found.readings.field() * MICROTESLA_PER[options.units]
    measured = strength(values) if msgtype == FIELD_TYPE else None
    return TopicReport(
        topic=topic,
        msgtype=msgtype,
        frames=tuple(sorted(found.frames)),
        count=count,
        rate_hz=_rate(gaps, count, duration_s),
        longest_gap_s=float(gaps.max()) if len(gaps) else float("nan"),
        span_s=_span(header),
        clock_offset_s=float(np.median(record - header)) * 1e-9 if len(header) else float("nan"),
        nan_share=float(np.mean(~np.isfinite(values).all(axis=1))) if len(values) else float("nan"),
        strength=measured,
        use=f"refused: {several_frames(topic, found.frames)}"
        if msgtype == FIELD_TYPE and len(found.frames) > 1 and not options.split_by_frame
        else _use(use, measured, is_turning(values), options, msgtype),
    )


def _rate(gaps: FloatArray, count: int, duration_s: float) -> float:
    """Return the rate of a topic in Hz; one message has none."""
    if len(gaps):
        return float(1 / np.median(gaps))
    return count / duration_s if count > 1 else float("nan")


def _span(stamps: IntArray) -> tuple[float, float]:
    if not len(stamps):
        return (float("nan"), float("nan"))
    return (float(stamps.min()) * 1e-9, float(stamps.max()) * 1e-9)


def _use(
    use: str | None, measured: Strength | None, turning: bool, options: BagOptions, msgtype: str
) -> str:
    if measured is not None:
        wrong = fault(measured, turning, options.units)
        if wrong:
            return f"refused: {wrong}"
    if use is not None:
        dead = measured is not None and not measured.readings
        return f"{use}, but none is finite: the sensor is dead" if dead else use
    if msgtype == FIELD_TYPE:
        return "not chosen by bag.fields"
    if msgtype in POSE_TYPES:
        return "poses, not used: another topic is preferred or must be chosen with bag.poses"
    if msgtype in TF_TYPES:
        return "transforms, used when bag.tf names a chain"
    if msgtype == CLOUD_TYPE:
        return "point clouds: a map's with --lidar, poses where there are no others"
    return "not needed"
