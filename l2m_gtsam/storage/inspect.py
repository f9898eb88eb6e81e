"""Say what is in a bag, and what would be used of it and why."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import L2MError
from l2m_gtsam.progress import Count
from l2m_gtsam.recording.pose_order import order_notes
from l2m_gtsam.recording.saturation import saturated_axes, saturation_sentence
from l2m_gtsam.storage.bag_options import BagOptions, Stamps
from l2m_gtsam.storage.clocks import UNSTAMPED, set_to_meet
from l2m_gtsam.storage.field_types import (
    FIELD_TYPES,
    VECTOR_TYPE,
    by_connection,
    field_source,
    is_field,
)
from l2m_gtsam.storage.messages import ALL_POSE_TYPES, PATH_TYPE, POSE_TYPES, TF_TYPES
from l2m_gtsam.storage.open_log import Log, open_log
from l2m_gtsam.storage.point_cloud2 import CLOUD_TYPE
from l2m_gtsam.storage.pose_files import read_poses
from l2m_gtsam.storage.selection import (
    other_poses,
    select_fields,
    select_poses,
    several_frames,
    why_poses,
)
from l2m_gtsam.storage.tf import chain_frames
from l2m_gtsam.storage.topic_content import (
    TopicContent,
    collect_paths,
    collected_topics,
    pose_fault,
)
from l2m_gtsam.storage.units import (
    PLAUSIBLE_UT,
    Strength,
    Unit,
    Units,
    field_fault,
    likely_units,
    microtesla_per,
    strength,
)

POSE_FILE = "file"
"""Type of what stands for a file with poses among topics."""


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
    use
        What would be used of it, and why, or why not.
    clock_offset_s
        Median of record time less header stamp in seconds.
    nan_share
        Share of readings with a NaN axis; NaN for other types.
    strength
        |B| in uT, for magnetic fields in a unit that is known.
    role
        `field`, `poses` or empty: what it would be used as.
    likely_units
        What its readings are likely in, where they are not in the unit of their type.
    links
        Parents and children of its transforms.
    """

    topic: str
    msgtype: str
    frames: tuple[str, ...]
    count: int
    rate_hz: float
    longest_gap_s: float
    span_s: tuple[float, float]
    use: str
    clock_offset_s: float = np.nan
    nan_share: float = np.nan
    strength: Strength | None = None
    role: str = ""
    likely_units: Units | None = None
    links: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class BagReport:
    """What is in a bag: its topics, what prevents its use, if anything, and what else to know."""

    path: Path
    topics: tuple[TopicReport, ...]
    obstacles: tuple[str, ...]
    notes: tuple[str, ...] = ()


BY_CLOUDS = "a map made with `l2m map build --lidar` gives poses to its point clouds"


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
    notes = []
    apart = options.pose_file.of(path)
    with open_log(path, options.columns) as bag:
        fields, no_fields = _selected(select_fields, bag, options)
        poses, no_poses = ([], "") if apart is not None else _selected(select_poses, bag, options)
        sources = {c.id: [field_source(c)] for c in bag.connections if c.msgtype in FIELD_TYPES}
        sources |= by_connection(fields)
        usable = [c for c in bag.connections if _is_usable(c) or c.id in sources]
        collected = collected_topics(bag, usable, sources, progress)
        if (fault := collect_paths(bag, poses, collected)) and not no_poses:
            no_poses = fault
        uses = {each.connection.topic: "magnetic readings" for each in fields}
        why = why_poses(other_poses(bag, poses), options)
        uses |= {c.topic: f"poses ({why})" for c in poses}
        topics, duration = _by_topic(bag), max(bag.duration_s, 1e-9)
        found = [
            _report(topic, connections, collected.get(topic), uses.get(topic), duration, options)
            for topic, connections in topics.items()
        ]
    roles = {c.topic: "poses" for c in poses}
    roles |= {each.connection.topic: "field" for each in fields}
    refused = _refused_poses(poses, collected, options)
    reports = [
        replace(each, use=refused.get(each.topic, each.use), role=roles.get(each.topic, ""))
        for each in found
    ]
    if no_poses and any(report.msgtype == CLOUD_TYPE for report in reports):
        notes.append(f"{no_poses}; {BY_CLOUDS}")
        no_poses = ""
    if apart is not None:
        read = read_poses(apart, options.pose_file)
        reports.append(_pose_file(apart, read, options))
        notes += order_notes(apart, read)
    obstacles = [reason for reason in (no_fields, no_poses) if reason]
    refusals = [r for r in reports if r.use.startswith("refused") and r.topic in uses]
    obstacles += [f"{r.topic}: {r.use}" for r in refusals]
    used = [collected.get(each.connection.topic) for each in fields]
    if fields and not any(each is not None and each.is_alive for each in used):
        obstacles.append("no magnetic topic has readings that change")
    # a static transform holds from any time on
    timed = [r for r in reports if r.topic in uses or r.msgtype == POSE_FILE]
    timed = [r for r in timed if "tf_static" not in r.topic]
    obstacles += _clock_obstacles(timed, options)
    return BagReport(path, tuple(reports), tuple(obstacles), tuple(notes))


def _refused_poses(
    poses: list[Connection], collected: dict[str, TopicContent], options: BagOptions
) -> dict[str, str]:
    """Return the topics whose poses would be used and cannot be, and why not."""
    bodies = {c.topic: collected[c.topic].bodies for c in poses if c.topic in collected}
    needed = None
    if options.tf is not None:
        needed = chain_frames([ends for each in bodies.values() for ends in each], options.tf.ends)
    faults = {topic: pose_fault(each, needed) for topic, each in bodies.items()}
    return {topic: f"refused: {fault}" for topic, fault in faults.items() if fault}


def _pose_file(path: Path, found: Trajectory, options: BagOptions) -> TopicReport:
    """Return what is known of a file with the poses."""
    gaps = np.diff(found.stamp_ns).astype(np.float64) * 1e-9
    return TopicReport(
        topic=str(path),
        msgtype=POSE_FILE,
        frames=(options.frame or found.frame,),
        count=len(found),
        rate_hz=_rate(gaps, len(found), 0.0),
        longest_gap_s=float(gaps.max()),
        span_s=_span(found.stamp_ns),
        use="poses (of --poses)",
    )


def _clock_obstacles(used: list[TopicReport], options: BagOptions) -> list[str]:
    """Return what is wrong with the header stamps of the topics that would be used."""
    if options.stamps is Stamps.RECORD:
        return []
    found = [f"{r.topic}: {UNSTAMPED}" for r in used if r.span_s == (0.0, 0.0)]
    moving = [r for r in used if np.isfinite(r.span_s[0]) and r.span_s[1] > 0]
    latest_start = max(moving, key=lambda r: r.span_s[0], default=None)
    earliest_end = min(moving, key=lambda r: r.span_s[1], default=None)
    if latest_start and earliest_end and latest_start.span_s[0] > earliest_end.span_s[1]:
        apart = next((Path(r.topic) for r in used if r.msgtype == POSE_FILE), None)
        found.append(
            f"{latest_start.topic} starts at {latest_start.span_s[0]:.3f} s, after "
            f"{earliest_end.topic} ends at {earliest_end.span_s[1]:.3f} s; if their clocks differ, "
            f"{set_to_meet(apart)}"
        )
    return found


def _selected(select: Any, bag: Log, options: BagOptions) -> tuple[list[Any], str]:
    """Return what a selection chooses, or why it cannot."""
    try:
        return select(bag, options), ""
    except L2MError as error:
        return [], str(error)


def _is_usable(connection: Connection) -> bool:
    return connection.msgtype in (*FIELD_TYPES, *POSE_TYPES, *TF_TYPES)


def _by_topic(bag: Log) -> dict[str, list[Connection]]:
    topics: dict[str, list[Connection]] = {}
    for connection in sorted(bag.connections, key=lambda c: c.topic):
        topics.setdefault(connection.topic, []).append(connection)
    return topics


def _report(
    topic: str,
    connections: list[Connection],
    found: TopicContent | None,
    use: str | None,
    duration_s: float,
    options: BagOptions,
) -> TopicReport:
    msgtype = connections[0].msgtype
    found = found or TopicContent()
    if use and len(found.covariances.row):
        use = f"{use}, {found.covariances.account()}"
    header, record = found.stamps.header(), found.stamps.record()
    gaps = np.diff(np.unique(header)).astype(np.float64) * 1e-9
    count = sum(c.msgcount for c in connections)
    written, field = found.readings.field(), _in_microtesla(found, options)
    return TopicReport(
        topic=topic,
        msgtype=msgtype,
        frames=tuple(sorted(found.frames - {""})),
        count=count,
        rate_hz=_rate(gaps, count, duration_s),
        longest_gap_s=float(gaps.max()) if len(gaps) else float("nan"),
        span_s=_span(header),
        clock_offset_s=float(np.median(record - header)) * 1e-9 if len(header) else float("nan"),
        nan_share=float(np.mean(~np.isfinite(written).all(axis=1))) if len(written) else np.nan,
        strength=None if field is None else strength(field),
        use=_use(use, connections[0], found, options),
        likely_units=likely_units(written, options.units, found.readings.unit),
        links=tuple(sorted(found.bodies)) if msgtype in TF_TYPES else (),
    )


def _in_microtesla(found: TopicContent, options: BagOptions) -> FloatArray | None:
    """Return the readings of a topic, shape (N, 3), if there are any in a unit that is known."""
    written, own = found.readings.field(), found.readings.unit
    if not len(written) or (own is None and options.units is Unit.AUTO):
        return None
    return written * microtesla_per(options.units, own)


def _rate(gaps: FloatArray, count: int, duration_s: float) -> float:
    """Return the rate of a topic in Hz; one message has none."""
    if len(gaps):
        return float(1 / np.median(gaps))
    return count / duration_s if count > 1 else float("nan")


def _span(stamps: IntArray) -> tuple[float, float]:
    if not len(stamps):
        return (float("nan"), float("nan"))
    return (float(stamps.min()) * 1e-9, float(stamps.max()) * 1e-9)


def _use(use: str | None, connection: Connection, found: TopicContent, options: BagOptions) -> str:
    """Return what would be used of a topic, and why, or why not."""
    if len(found.readings.stamp_ns) or found.fault:
        return _field_use(use, connection, found, options)
    if use is not None:
        return use
    if connection.msgtype in FIELD_TYPES:
        return "a magnetometer's topic without messages"
    if connection.msgtype == PATH_TYPE:
        return "paths, not used: another topic has poses, or choose it with `bag.poses`"
    if connection.msgtype in ALL_POSE_TYPES:
        known = ", with covariance" if found.covariances.are_known else ""
        reason = "another topic is preferred or must be chosen with bag.poses"
        return f"poses{known}, not used: {reason}"
    if connection.msgtype in TF_TYPES:
        return "transforms, used when bag.tf names a chain"
    if connection.msgtype == CLOUD_TYPE:
        return "point clouds: a map's with --lidar, poses where there are no others"
    return "not needed"


def _field_use(
    use: str | None, connection: Connection, found: TopicContent, options: BagOptions
) -> str:
    """Return what would be used of a topic with readings."""
    if use is None and not is_field(connection) and connection.msgtype == VECTOR_TYPE:
        return "vectors: of a magnetometer if `bag.fields` names them"
    if found.fault:
        return f"refused: it {found.fault}"
    if len(found.frames) > 1 and not options.split_by_frame:
        return f"refused: {several_frames(connection.topic, found.frames)}"
    written, own = found.readings.field(), found.readings.unit
    if wrong := field_fault(written, options.units, own):
        return f"refused: {wrong}"
    use = use or "magnetic readings, not chosen by bag.fields"
    if not np.isfinite(written).all(axis=1).any():
        return f"{use}, but none is finite: the sensor is dead"
    if found.is_alive:
        return f"{use}{_beyond_range(found, options)}"
    constant = written[np.isfinite(written).all(axis=1)][0]
    text = ", ".join(f"{value:.4g}" for value in constant)
    size = float(np.linalg.norm(constant)) * microtesla_per(options.units, own)
    low, high = PLAUSIBLE_UT
    no_field = "" if low <= size <= high else f", and {size:.3g} uT is no field on Earth"
    return f"{use}, but all are ({text}) as written: the sensor is stuck{no_field}"


def _beyond_range(found: TopicContent, options: BagOptions) -> str:
    """Return which limits of its range the readings of a topic exceed; empty if none."""
    field = _in_microtesla(found, options)
    limits = () if field is None else saturated_axes(field[np.isfinite(field).all(axis=1)])
    return f", but {saturation_sentence(limits)}" if limits else ""
