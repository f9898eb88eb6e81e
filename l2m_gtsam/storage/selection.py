"""Which topics of a bag are used, and what they are called."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from rosbags.interfaces import Connection

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.field_types import (
    FIELD_TYPE,
    FIELD_TYPES,
    VECTOR_TYPE,
    FieldSource,
    field_source,
    is_field,
    named_source,
)
from l2m_gtsam.storage.messages import ALL_POSE_TYPES, TF_TYPES
from l2m_gtsam.storage.open_log import Log

ROS_POSE_TYPES = tuple(each for each in ALL_POSE_TYPES if not each.startswith("csv/"))
WITH_COVARIANCE = [each for each in ALL_POSE_TYPES if "Covariance" in each or "Odometry" in each]
GLOB = re.compile(r"[*?\[]")


def select_fields(bag: Log, options: BagOptions) -> list[FieldSource]:
    """Return where the readings that are used stand.

    Of a pattern that matches topics of several types only those of the most immediate type are
    taken; a topic whose name is given counts whatever its type is known for.

    Raises
    ------
    BagError
        A pattern matches nothing, or a topic of another type.
    """
    chosen: list[FieldSource] = []
    for pattern in options.fields:
        found = fields_of_pattern(bag, pattern)
        if not found:
            raise BagError(_no_field(bag, pattern))
        labels = {(each.label, each.connection.id) for each in chosen}
        chosen.extend(s for s in found if (s.label, s.connection.id) not in labels)
    return chosen


def fields_of_pattern(bag: Log, pattern: str) -> list[FieldSource]:
    """Return where the readings that a pattern names stand; empty if it matches none.

    Parameters
    ----------
    bag
        The log.
    pattern
        One of `bag.fields`.
    """
    topic, colon, path = pattern.partition(":")
    if colon:
        return [named_source(c, path) for c in bag.connections if matches(c.topic, topic)]
    if not GLOB.search(pattern):
        named = [c for c in bag.connections if matches(c.topic, pattern)]
        return [field_source(c) for c in named if c.msgtype in FIELD_TYPES]
    fitting = [c for c in bag.connections if is_field(c) and matches(c.topic, pattern)]
    filled = [c for c in fitting if c.msgcount] or fitting
    lowest = min((FIELD_TYPES[c.msgtype].rank for c in filled), default=0)
    return [field_source(c) for c in fitting if FIELD_TYPES[c.msgtype].rank == lowest]


def select_poses(bag: Log, options: BagOptions) -> list[Connection]:
    """Return the connections that the poses come from.

    Raises
    ------
    BagError
        No such topic, another type, or several candidates.
    """
    if options.tf is not None:
        chosen = [c for c in bag.connections if c.msgtype in TF_TYPES]
        if not chosen:
            raise BagError(f"{bag.path}: no /tf in the bag, but `bag.tf` asks for a chain")
        return chosen
    available = [c for c in bag.connections if c.msgtype in ALL_POSE_TYPES]
    if options.poses is not None:
        return _named_poses(bag, options.poses, available)
    for msgtype in ALL_POSE_TYPES:
        if of_type := [c for c in available if c.msgtype == msgtype]:
            topic = _one_topic(bag, of_type)
            return [c for c in available if c.topic == topic]
    raise BagError(
        f"{bag.path}: no poses in it; needed is a topic of one of the types "
        f"{', '.join(map(_short, ROS_POSE_TYPES))}, a /tf chain named by "
        f"`bag.tf`, or a file with `--poses`; there are: {listed(bag.connections)}"
    )


def other_poses(bag: Log, chosen: Sequence[Connection]) -> list[Connection]:
    """Return one connection of each topic that has poses beside those that are used.

    Parameters
    ----------
    bag
        The log.
    chosen
        Where the poses come from.
    """
    used = {c.topic for c in chosen}
    available = [c for c in bag.connections if c.msgtype in ALL_POSE_TYPES and c.msgcount]
    found = {c.topic: c for c in available if c.topic not in used}
    return sorted(found.values(), key=lambda c: (ALL_POSE_TYPES.index(c.msgtype), c.topic))


def why_poses(others: Sequence[Connection], options: BagOptions) -> str:
    """Return in a clause why the poses are those of a topic.

    Parameters
    ----------
    others
        Which other topics have some.
    options
        What was asked for.
    """
    if options.tf is not None:
        return f"chain {options.tf.frame} to {options.tf.child_frame}"
    if options.poses is not None:
        return "named by bag.poses"
    if not others:
        return "the only topic with poses"
    told = ", ".join(c.topic for c in others[:10])
    return f"preferred to {told}; `bag.poses` chooses"


def pose_notes(bag: Log, chosen: Sequence[Connection], options: BagOptions) -> tuple[str, ...]:
    """Return a sentence on which poses are used, where other topics have some and none is named.

    Not of others that cannot have a covariance: a path repeats poses or is a plan, and a pose
    without one is, beside odometry, most often the truth.

    Parameters
    ----------
    bag, chosen, options
        The log, where the poses come from, and what was asked for.
    """
    others = [c for c in other_poses(bag, chosen) if c.msgtype in WITH_COVARIANCE]
    named = options.tf is not None or options.poses is not None
    if named or not chosen or not others:
        return ()
    return (f"{bag.path}: poses are those of {chosen[0].topic}, {why_poses(others, options)}",)


def _short(msgtype: str) -> str:
    return msgtype.rpartition("/")[2]


def matches(topic: str, pattern: str) -> bool:
    """Return whether a topic fits a name or glob, whatever their leading slashes."""
    return fnmatchcase(topic.lstrip("/"), pattern.lstrip("/"))


def listed(connections: Iterable[Connection]) -> str:
    """Return topics with their types, at most ten."""
    topics = sorted({f"{c.topic} ({c.msgtype})" for c in connections})
    more = f" and {len(topics) - 10} more" if len(topics) > 10 else ""
    return (", ".join(topics[:10]) or "(none)") + more


def several_frames(topic: str, frames: Iterable[str]) -> str:
    """Return what is wrong with one topic that carries readings in several frames."""
    return (
        f"{topic} carries readings in several frames ({', '.join(sorted(frames)[:10])}); set "
        "`bag.split_by_frame: true` if they are different sensors"
    )


def sensor_names(
    path: Path, keys: Collection[tuple[str, str]], options: BagOptions
) -> dict[tuple[str, str], str]:
    """Name the sensors, by topic and frame: the topic without its leading slash, or the frame.

    A frame that several topics share, or none, does not identify a sensor: then the topic does,
    with the frame after it.

    Raises
    ------
    BagError
        A topic of the bag, which ``path`` names, has several frames and is not to be split.
    """
    by_topic = {(topic, frame): topic.lstrip("/") for topic, frame in keys}
    if not options.split_by_frame:
        for topic, count in Counter(topic for topic, _ in keys).items():
            if count > 1:
                frames_there = [frame for each, frame in keys if each == topic]
                raise BagError(f"{path}: {several_frames(topic, frames_there)}")
        return by_topic
    frames = Counter(frame for _, frame in keys)
    return {
        (topic, frame): frame.lstrip("/")
        if frame and frames[frame] == 1
        else "/".join(filter(None, (by_topic[topic, frame], frame.lstrip("/"))))
        for topic, frame in keys
    }


def _no_field(bag: Log, pattern: str) -> str:
    topic, colon, _ = pattern.partition(":")
    others = [] if GLOB.search(topic) else [c for c in bag.connections if matches(c.topic, topic)]
    available = [c for c in bag.connections if is_field(c)]
    if others and not colon:
        return (
            f"{bag.path}: topic {others[0].topic} is of type {others[0].msgtype}, in which no "
            f"magnetic reading is known; name the vector in it, `{pattern}:PATH`, or another "
            f"topic; with readings there are: {listed(available)}"
        )
    asked = "" if pattern == "*" else f" that matches {topic!r}"
    if colon or available:
        there = available or bag.connections
        return f"{bag.path}: no topic of a magnetometer{asked}; there are: {listed(there)}"
    vectors = [c for c in bag.connections if c.msgtype == VECTOR_TYPE]
    hint = f"; if {vectors[0].topic} has one, say so with `bag.fields`" if vectors else ""
    return (
        f"{bag.path}: no topic of a magnetometer ({FIELD_TYPE} or a driver's own){asked}{hint}; "
        f"there are: {listed(bag.connections)}"
    )


def _one_topic(bag: Log, with_poses: list[Connection]) -> str:
    topics = sorted({c.topic for c in with_poses})
    if len(topics) > 1:
        raise BagError(
            f"{bag.path}: several topics carry poses, choose one with `bag.poses`: "
            f"{', '.join(topics)}"
        )
    return topics[0]


def _named_poses(bag: Log, name: str, available: list[Connection]) -> list[Connection]:
    chosen = [c for c in available if matches(c.topic, name)]
    if chosen:
        _one_topic(bag, chosen)  # a glob may fit several
        return chosen
    others = [c for c in bag.connections if matches(c.topic, name)]
    if others:
        raise BagError(
            f"{bag.path}: topic {others[0].topic} is of type {others[0].msgtype}, poses must be "
            f"one of {', '.join(ROS_POSE_TYPES)}"
        )
    raise BagError(
        f"{bag.path}: no topic {name!r} for the poses; with poses there are: {listed(available)}"
    )
