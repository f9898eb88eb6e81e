"""What the messages on a topic say, as far as it is needed to judge the topic."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.errors import L2MError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag import path_trajectory
from l2m_gtsam.storage.field_types import FieldSource
from l2m_gtsam.storage.messages import (
    PATH_TYPE,
    TF_TYPES,
    CovarianceBuffer,
    FieldBuffer,
    PoseBuffer,
    StampBuffer,
    bodies_fault,
    ends_of,
    frame_of,
    stamp_of,
    stamped_poses,
)
from l2m_gtsam.storage.open_bag import Bag
from l2m_gtsam.storage.open_log import Log
from l2m_gtsam.storage.units import is_turning, strength

Bodies = dict[tuple[str, str], PoseBuffer]
"""The poses of a topic, by parent and child."""


@dataclass
class TopicContent:
    """What was collected of a topic.

    Attributes
    ----------
    stamps, frames
        Of the headers.
    readings, covariances, bodies
        Of the messages that have them.
    fault
        Why readings cannot be had; empty if they can.
    """

    stamps: StampBuffer = field(default_factory=StampBuffer)
    frames: set[str] = field(default_factory=set)
    readings: FieldBuffer = field(default_factory=lambda: FieldBuffer("", ""))
    covariances: CovarianceBuffer = field(default_factory=CovarianceBuffer)
    bodies: Bodies = field(default_factory=dict)
    fault: str = ""

    @property
    def is_alive(self) -> bool:
        """Whether there are readings, and not always the same; a single one may be."""
        written = self.readings.field()
        if len(written) == 1:
            return bool(np.isfinite(written).all())
        return is_turning(written) or not strength(written).is_constant


def pose_fault(bodies: Bodies, needed: set[str] | None) -> str:
    """Return what is wrong with the poses of a topic, of these frames alone if they are given."""
    if needed is None and (wrong := bodies_fault(bodies)):
        return wrong
    for (_, child), buffer in sorted(bodies.items()):
        if needed is not None and child not in needed:
            continue
        try:
            buffer.link()
        except ValueError as error:
            return f"{error} ({child})" if needed is not None else str(error)
    return ""


def collected_topics(
    bag: Log,
    usable: list[Connection],
    sources: dict[int, list[FieldSource]],
    progress: Count | None,
) -> dict[str, TopicContent]:
    """Return what the messages on usable topics say."""
    collected: dict[str, TopicContent] = {}
    for message in bag.messages(usable, progress):
        into = collected.setdefault(message.connection.topic, TopicContent())
        there = sources.get(message.connection.id, [])
        _collect(into, message.content, message.connection.msgtype, message.record_ns, there)
    return collected


def collect_paths(bag: Log, poses: list[Connection], collected: dict[str, TopicContent]) -> str:
    """Add the stamps of poses that come from paths; return what is wrong with them, if anything."""
    paths = [c for c in poses if c.msgtype == PATH_TYPE]
    if not paths or not isinstance(bag, Bag):
        return ""
    try:
        found = path_trajectory(bag, paths, None)
    except (L2MError, ValueError) as error:
        return str(error)
    into = collected.setdefault(paths[0].topic, TopicContent())
    into.frames.add(found.frame)
    for stamp in found.stamp_ns.tolist():
        into.stamps.add(stamp, stamp)
    return ""


def _collect(
    into: TopicContent, content: Any, msgtype: str, record_ns: int, sources: list[FieldSource]
) -> None:
    is_tf = msgtype in TF_TYPES
    for stamped in content.transforms if is_tf else (content,):
        into.stamps.add(stamp_of(stamped, record_ns), record_ns)
        into.frames.add(frame_of(stamped))
    for stamped, pose in stamped_poses(content, msgtype):
        ends = ends_of(stamped, pose, msgtype)
        body = into.bodies.setdefault(ends, PoseBuffer(*ends))
        body.add(stamp_of(stamped, record_ns), pose.position, pose.orientation)
        if pose.covariance is not None:
            into.covariances.add(pose.covariance)
    for source in [] if into.fault else sources:
        into.readings.unit = source.unit
        try:
            into.readings.add(record_ns, source.reading(content))
        except ValueError as error:
            into.fault = str(error)
