"""Poses as they come, kept to be judged: what `inspect` says of them."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from l2m_gtsam.storage.bag_options import TfChain
from l2m_gtsam.storage.messages import POSE_TYPES, TF_TYPES, PoseBuffer, header_ns, stamp_of
from l2m_gtsam.storage.tf import chain_frames


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
