"""What the messages on a topic say, as far as it is needed to judge the topic."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.errors import L2MError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag import path_trajectory
from l2m_gtsam.storage.bag_options import TfChain
from l2m_gtsam.storage.field_types import FieldSource
from l2m_gtsam.storage.log import Log
from l2m_gtsam.storage.messages import (
    PATH_TYPE,
    POSE_TYPES,
    TF_TYPES,
    CovarianceBuffer,
    FieldBuffer,
    PoseBuffer,
    StampBuffer,
    frame_of,
    header_ns,
    stamp_of,
)
from l2m_gtsam.storage.open_bag import Bag
from l2m_gtsam.storage.tf import chain_frames
from l2m_gtsam.storage.units import is_turning, strength


@dataclass
class PoseCheck:
    """The poses of a topic, by parent and child."""

    bodies: dict[tuple[str, str], PoseBuffer] = field(default_factory=dict)

    def add(self, content: Any, msgtype: str, record_ns: int) -> None:
        """Take in a message, if it has poses."""
        if msgtype in TF_TYPES:
            for item in content.transforms:
                ends = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
                placed = item.transform
                self._body(ends).add(header_ns(item), placed.translation, placed.rotation)
        elif msgtype in POSE_TYPES:
            pose = POSE_TYPES[msgtype](content)
            self._body(("", pose.child_frame)).add(
                stamp_of(content, record_ns), pose.position, pose.orientation
            )

    def fault(self, needed: set[str] | None) -> str:
        """Return what is wrong with the poses, of these frames alone if they are given."""
        for (_, child), buffer in sorted(self.bodies.items()):
            if needed is not None and child not in needed:
                continue
            try:
                buffer.link()
            except ValueError as error:
                return f"{error} ({child})" if needed is not None else str(error)
        return ""

    def _body(self, ends: tuple[str, str]) -> PoseBuffer:
        return self.bodies.setdefault(ends, PoseBuffer(*ends))


def needed_frames(checks: Iterable[PoseCheck], chain: TfChain | None) -> set[str] | None:
    """Return the frames that a chain needs, of all topics together; None without a chain."""
    if chain is None:
        return None
    return chain_frames([ends for each in checks for ends in each.bodies], chain.ends)


@dataclass
class TopicContent:
    """What was collected of a topic.

    Attributes
    ----------
    stamps, frames
        Of the headers.
    readings, covariances, poses
        Of the messages that have them.
    fault
        Why readings cannot be had; empty if they can.
    """

    stamps: StampBuffer = field(default_factory=StampBuffer)
    frames: set[str] = field(default_factory=set)
    readings: FieldBuffer = field(default_factory=lambda: FieldBuffer("", ""))
    covariances: CovarianceBuffer = field(default_factory=CovarianceBuffer)
    poses: PoseCheck = field(default_factory=PoseCheck)
    fault: str = ""

    @property
    def is_alive(self) -> bool:
        """Whether there are readings, and not always the same; a single one may be."""
        written = self.readings.field()
        if len(written) == 1:
            return bool(np.isfinite(written).all())
        return is_turning(written) or not strength(written).is_constant


def collected_topics(
    bag: Log, usable: list[Connection], sources: dict[int, FieldSource], progress: Count | None
) -> dict[str, TopicContent]:
    """Return what the messages on usable topics say."""
    collected: dict[str, TopicContent] = {}
    for message in bag.messages(usable, progress):
        into = collected.setdefault(message.connection.topic, TopicContent())
        source = sources.get(message.connection.id)
        _collect(into, message.content, message.connection.msgtype, message.record_ns, source)
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
    into: TopicContent, content: Any, msgtype: str, record_ns: int, source: FieldSource | None
) -> None:
    for stamped in _stamped(content, msgtype):
        into.stamps.add(stamp_of(stamped, record_ns), record_ns)
        into.frames.add(frame_of(stamped))
    into.poses.add(content, msgtype, record_ns)
    if source is not None and not into.fault:
        into.readings.unit = source.unit
        try:
            into.readings.add(record_ns, source.reading(content))
        except ValueError as error:
            into.fault = str(error)
    if msgtype in POSE_TYPES and (pose := POSE_TYPES[msgtype](content)).covariance is not None:
        into.covariances.add(pose.covariance)


def _stamped(content: Any, msgtype: str) -> Sequence[Any]:
    """Return what has stamps in a message."""
    return tuple(content.transforms) if msgtype in TF_TYPES else (content,)
