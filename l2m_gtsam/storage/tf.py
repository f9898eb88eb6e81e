"""Chains of transforms from ``/tf`` and ``/tf_static``."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.recording.sync import longest_gap_ns


@dataclass(frozen=True)
class Link:
    """Transforms of one child frame in its parent, in order of time.

    Attributes
    ----------
    parent, child
        Frame names.
    stamp_ns
        Times in nanoseconds, shape (N,); empty for a static link, which has one transform.
    R, p
        Rotation (N, 3, 3) and position (N, 3) in metres of the child in the parent.
    """

    parent: str
    child: str
    stamp_ns: IntArray
    R: FloatArray
    p: FloatArray

    @property
    def is_static(self) -> bool:
        """Whether the link never changes."""
        return len(self.stamp_ns) == 0

    def at(self, stamp_ns: IntArray) -> "Link":
        """Return the link at these times, within its own; slerp and straight line between."""
        if self.is_static:
            R = np.broadcast_to(self.R[0], (len(stamp_ns), 3, 3))
            p = np.broadcast_to(self.p[0], (len(stamp_ns), 3))
            return Link(self.parent, self.child, stamp_ns, R, p)
        seconds = (self.stamp_ns - self.stamp_ns[0]) * 1e-9
        wanted = (stamp_ns - self.stamp_ns[0]) * 1e-9
        p = np.column_stack([np.interp(wanted, seconds, axis) for axis in self.p.T])
        if len(seconds) == 1:
            R = np.broadcast_to(self.R[0], (len(stamp_ns), 3, 3))
        else:
            R = Slerp(seconds, Rotation.from_matrix(self.R))(wanted).as_matrix()
        return Link(self.parent, self.child, stamp_ns, R, p)

    def inverse(self) -> "Link":
        """Return the parent in the child."""
        R = self.R.transpose(0, 2, 1)
        p = -np.einsum("nij,nj->ni", R, self.p)
        return Link(self.child, self.parent, self.stamp_ns, R, p)


def compose(
    links: dict[str, Link], frame: str, child_frame: str, max_gap_s: float, where: str
) -> Trajectory:
    """Return the poses of ``child_frame`` in ``frame`` at the stamps of the fastest link between.

    Parameters
    ----------
    links
        Links by child frame.
    frame, child_frame
        Ends of the chain.
    max_gap_s
        Stamps within a longer gap of any moving link get no pose, in seconds.
    where
        Name of the bag, for errors.

    Raises
    ------
    BagError
        No chain connects the frames, or nothing in it moves.
    """
    chain = _chain(links, frame, child_frame, where)
    moving = [link for link in chain if not link.is_static]
    if not moving:
        raise BagError(
            f"{where}: every transform between {frame!r} and {child_frame!r} is static; poses "
            "need a moving one"
        )
    start = max(int(link.stamp_ns[0]) for link in moving)
    end = min(int(link.stamp_ns[-1]) for link in moving)
    fastest = max(moving, key=lambda link: len(link.stamp_ns)).stamp_ns
    stamps = fastest[(fastest >= start) & (fastest <= end)]
    for link in moving:
        stamps = stamps[longest_gap_ns(link.stamp_ns, stamps) <= max_gap_s * 1e9]
    R, p = np.broadcast_to(np.eye(3), (len(stamps), 3, 3)), np.zeros((len(stamps), 3))
    for link in chain:
        step = link.at(stamps)
        p = p + np.einsum("nij,nj->ni", R, step.p)
        R = R @ step.R
    return Trajectory(stamps, R, p, frame, child_frame)


def chain_frames(links: Iterable[tuple[str, str]], ends: tuple[str, str]) -> set[str]:
    """Return the frames from both ends of a chain up to where their trees begin.

    Parameters
    ----------
    links
        Parent and child of each transform.
    ends
        Of the chain.
    """
    parents = {child: parent for parent, child in links}
    return {frame for end in ends for frame in _ancestry(parents, end)}


def _ancestry(parents: dict[str, str], frame: str) -> list[str]:
    """Return a frame and all above it that have a parent; stops where a chain bites its tail."""
    found: list[str] = []
    while frame in parents and frame not in found:
        found.append(frame)
        frame = parents[frame]
    return found


def _chain(links: dict[str, Link], frame: str, child_frame: str, where: str) -> list[Link]:
    """Return the links from ``frame`` down to ``child_frame``, over their common ancestor."""
    parents = {child: link.parent for child, link in links.items()}
    down, up = ([links[each] for each in _ancestry(parents, end)] for end in (child_frame, frame))
    known = sorted({*parents, *parents.values()})
    ancestors = [frame, *(link.parent for link in up)]
    for depth, meeting in enumerate([child_frame, *(link.parent for link in down)]):
        if meeting in ancestors:
            climbed = up[: ancestors.index(meeting)]
            return [*(link.inverse() for link in climbed), *reversed(down[:depth])]
    raise BagError(
        f"{where}: no tf chain from {frame!r} to {child_frame!r}; the bag has the frames "
        f"{', '.join(known) or '(none)'}"
    )
