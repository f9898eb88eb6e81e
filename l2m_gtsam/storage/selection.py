"""Which topics of a bag are used, and what they are called."""

from collections import Counter
from collections.abc import Iterable
from fnmatch import fnmatchcase

from rosbags.interfaces import Connection

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.messages import FIELD_TYPE, POSE_TYPES, TF_TYPES
from l2m_gtsam.storage.open_bag import Bag


def select_fields(bag: Bag, options: BagOptions) -> list[Connection]:
    """Return the connections whose readings are used.

    Raises
    ------
    BagError
        A pattern matches nothing, or a topic of another type.
    """
    available = [c for c in bag.connections if c.msgtype == FIELD_TYPE]
    chosen: list[Connection] = []
    for pattern in options.fields:
        found = [c for c in available if matches(c.topic, pattern)]
        if not found:
            raise BagError(_no_field(bag, pattern, available))
        chosen.extend(c for c in found if c not in chosen)
    return chosen


def select_poses(bag: Bag, options: BagOptions) -> list[Connection]:
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
    available = [c for c in bag.connections if c.msgtype in POSE_TYPES]
    if options.poses is not None:
        return _named_poses(bag, options.poses, available)
    for msgtype in POSE_TYPES:
        topics = sorted({c.topic for c in available if c.msgtype == msgtype})
        if len(topics) == 1:
            return [c for c in available if c.topic == topics[0]]
        if topics:
            raise BagError(
                f"{bag.path}: several topics carry poses, choose one with `bag.poses`: "
                f"{', '.join(topics)}"
            )
    raise BagError(
        f"{bag.path}: no poses in the bag; needed is a topic of one of the types "
        f"{', '.join(POSE_TYPES)}, or a /tf chain named by `bag.tf`; there are: "
        f"{listed(bag.connections)}"
    )


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
    keys: Iterable[tuple[str, str]], options: BagOptions
) -> dict[tuple[str, str], str]:
    """Name the sensors, by topic and frame: the topic without its leading slash, or the frame.

    A frame that several topics share, or none, does not identify a sensor: then the topic does,
    with the frame after it.
    """
    keys = list(keys)
    frames = Counter(frame for _, frame in keys)
    by_topic = {(topic, frame): topic.lstrip("/") for topic, frame in keys}
    if not options.split_by_frame:
        return by_topic
    return {
        (topic, frame): frame.lstrip("/")
        if frame and frames[frame] == 1
        else "/".join(filter(None, (by_topic[topic, frame], frame.lstrip("/"))))
        for topic, frame in keys
    }


def _no_field(bag: Bag, pattern: str, available: list[Connection]) -> str:
    others = [c for c in bag.connections if matches(c.topic, pattern)]
    if others and pattern != "*":
        return (
            f"{bag.path}: topic {others[0].topic} is of type {others[0].msgtype}, magnetic "
            f"readings must be {FIELD_TYPE}; of that type there are: {listed(available)}"
        )
    asked = "" if pattern == "*" else f" that matches {pattern!r}"
    there = available or bag.connections
    return f"{bag.path}: no topic of type {FIELD_TYPE}{asked}; there are: {listed(there)}"


def _named_poses(bag: Bag, name: str, available: list[Connection]) -> list[Connection]:
    chosen = [c for c in available if matches(c.topic, name)]
    if chosen:
        return chosen
    others = [c for c in bag.connections if matches(c.topic, name)]
    if others:
        raise BagError(
            f"{bag.path}: topic {others[0].topic} is of type {others[0].msgtype}, poses must be "
            f"one of {', '.join(POSE_TYPES)}"
        )
    raise BagError(
        f"{bag.path}: no topic {name!r} for the poses; with poses there are: {listed(available)}"
    )
