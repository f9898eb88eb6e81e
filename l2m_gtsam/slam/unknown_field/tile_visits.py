"""Visits of tiles: what each found of the field that earlier ones left."""

from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.unknown_field.changed_visits import (
    EarlierField,
    Motion,
    Remembered,
    Seen,
    VisitEvidence,
)
from l2m_gtsam.slam.unknown_field.linear_field import LinearField
from l2m_gtsam.slam.unknown_field.visit_graph import VisitGraph

CLEAR = 10.0  # in nats: odds of 22,000 to 1 that the field changed
LIKELY = 0.5  # where something was moved on this drive, its field reaches other tiles, too
SWEEPS = 4  # over all visits, for changes and motions together


@dataclass(frozen=True)
class Visit:
    """Key poses that pass through a tile at one time.

    Attributes
    ----------
    tile
        Its number.
    key_poses
        Ascending.
    field
        Waves of the tile.
    T_anchor_node
        Pose of the visit, that of its middle, in the frame of the tile's anchor.
    seen
        Its readings in that frame.
    """

    tile: int
    key_poses: IntArray
    field: LinearField
    T_anchor_node: gtsam.Pose3
    seen: Seen

    @property
    def begun(self) -> int:
        """Number of its first key pose; no two visits share it."""
        return int(self.key_poses[0])

    @property
    def middle(self) -> int:
        """Key pose that the visit is known by."""
        return middle_of(self.key_poses)

    def at(self, T_anchor_node: gtsam.Pose3) -> "Visit":
        """Return it elsewhere."""
        moved = T_anchor_node.compose(self.T_anchor_node.inverse())
        R, p = moved.rotation().matrix(), moved.translation()
        seen = replace(self.seen, points=self.seen.points @ R.T + p, field=self.seen.field @ R.T)
        return replace(self, T_anchor_node=T_anchor_node, seen=seen)

    def without(self, field: FloatArray) -> "Visit":
        """Return it without a field in its readings, in the anchor's frame, uT, shape (n, 3)."""
        return replace(self, seen=replace(self.seen, field=self.seen.field - field))

    def parts(self, cut: int) -> tuple["Visit", "Visit"]:
        """Return its part before a key pose, and that from there on.

        Readings beside the cut may be of either.
        """
        early, at = self.key_poses < cut, self.seen.key_pose
        return (
            replace(self, key_poses=self.key_poses[early], seen=self.seen[at < cut - 1]),
            replace(self, key_poses=self.key_poses[~early], seen=self.seen[at > cut]),
        )

    @cached_property
    def remembered(self) -> Remembered:
        """What its readings say of the field."""
        return Remembered.of(self.field, self.seen)


def middle_of(key_poses: IntArray) -> int:
    """Return the key pose in the middle of some."""
    return int(key_poses[len(key_poses) // 2])


@dataclass(frozen=True)
class Judged:
    """A visit to a tile that is known, and how likely it is that its field changed.

    Attributes
    ----------
    visit
        Where it is now known to have been.
    first, T_anchor_first
        Number of the first visit since the tile's field last changed, and its pose.
    before
        Key pose that the visit before is known by.
    earlier
        The field as visits between know it.
    evidence
        What the visit says of its motion.
    known
        What is known of that motion otherwise, once it was asked.
    share
        Likeliest change, as a place among those that are asked.
    gain
        How much likelier it is than none, in nats.
    """

    visit: Visit
    first: int
    T_anchor_first: gtsam.Pose3
    before: int
    earlier: EarlierField
    evidence: VisitEvidence
    known: Motion | None = None
    share: int = 0
    gain: float = 0.0

    @property
    def motion(self) -> Motion:
        """What it says of its motion relative to the first visit."""
        return self.evidence.motions[self.share if self.gain > LIKELY else 0]

    def cut(self) -> int | None:
        """Return the key pose of the visit at which the field changed; none if it did before."""
        if self.known is None:
            return None
        whole, best = self.evidence.likelihoods(self.known).max(), None
        at = self.visit.T_anchor_node
        for cut in self.visit.key_poses[1:].tolist():
            before = self.visit.seen.key_pose < cut
            early, late = (
                VisitEvidence.of(self.visit.field, self.earlier, self.visit.seen[rows], at)
                for rows in (before, ~before)
            )
            value = early.followed_by(late).likelihoods(self.known).max()
            if value > whole + CLEAR:
                whole, best = value - CLEAR, cut
        return best

    @property
    def span(self) -> tuple[int, int]:
        """Key poses between which the field changed, if it did."""
        return self.before, self.visit.middle


@dataclass(frozen=True)
class JudgedVisits:
    """All visits to known tiles.

    Attributes
    ----------
    visits
        By their numbers.
    graph
        Where all visits are.
    """

    visits: dict[int, Judged]
    graph: VisitGraph

    @classmethod
    def of(cls, visits: list[Visit], graph: VisitGraph, new: frozenset[int]) -> "JudgedVisits":
        """Return them with the likeliest changes.

        Parameters
        ----------
        visits
            All visits, in the order of time.
        graph
            Where they are believed to be.
        new
            First key poses of those from which on a tile has another field.
        """
        judged = dict[int, Judged]()
        for _ in range(SWEEPS):
            judged = evidence(visits, graph, new, judged)
            solved = graph.solved({k: (each.first, each.motion) for k, each in judged.items()})
            for k, each in judged.items():
                known = solved.without(each.first, k, each.motion)
                values = each.evidence.likelihoods(known)
                best = int(np.argmax(values))
                gain = float(values[best] - values[0])
                judged[k] = replace(each, known=known, share=best, gain=gain)
            graph = solved.moved()
        return cls(judged, graph)

    def first_change(self) -> "Change | None":
        """Return when something was moved, the first time that a visit clearly shows it.

        Later visits are to be judged anew then: what is known of their tiles is of two fields yet.
        """
        sure = [each.span for each in self.visits.values() if each.gain > CLEAR]
        if not sure:
            return None
        end = min(last for _, last in sure)
        return Change(max(first for first, _ in sure if first < end), end)

    @property
    def changed(self) -> float:
        """Share of the visits that clearly show a change."""
        return float(np.mean([each.gain > CLEAR for each in self.visits.values()]))

    def cut(self, change: "Change") -> int | None:
        """Return the key pose at which something was moved while a tile was visited, if it was."""
        return next(e.cut() for e in self.visits.values() if e.visit.middle == change.end)

    def after(self, change: "Change") -> tuple[int, ...]:
        """Return the first visits after a change of tiles that were visited before it."""
        spans = ((k, *each.span) for k, each in self.visits.items())
        return tuple(k for k, first, last in spans if first <= change.begin and last >= change.end)

    def during(self, change: "Change") -> tuple[int, ...]:
        """Return the visits of which it is not known whether they were before or after a change."""
        return tuple(
            k for k, e in self.visits.items() if change.begin < e.visit.middle < change.end
        )


@dataclass(frozen=True)
class Change:
    """Something was moved between two key poses.

    Attributes
    ----------
    begin, end
        Their numbers: those in the middle of the last visit before and of the first one after.
    """

    begin: int
    end: int


def evidence(
    visits: list[Visit], graph: VisitGraph, new: frozenset[int], before: dict[int, Judged]
) -> dict[int, Judged]:
    """Return what visits to known tiles say of their motions.

    Parameters
    ----------
    visits, graph, new
        As of ``JudgedVisits.of``.
    before
        The changes that they were taken to have found.
    """
    judged, first, last = dict[int, Judged](), dict[int, int](), dict[int, int]()
    known = dict[int, Remembered]()
    for k, visit in enumerate(visits):
        tile = visit.tile
        if tile not in known or visit.begun in new:
            first[tile], known[tile] = k, visit.remembered
        else:
            origin = visits[first[tile]].T_anchor_node
            moved = visit.at(origin.compose(graph.between(first[tile], k)))
            earlier = EarlierField.of(known[tile])
            own = VisitEvidence.of(moved.field, earlier, moved.seen, moved.T_anchor_node)
            judged[k] = Judged(moved, first[tile], origin, last[tile], earlier, own)
            if k in before:
                judged[k] = replace(judged[k], share=before[k].share, gain=before[k].gain)
            known[tile] += moved.remembered
        last[tile] = visit.middle
    return judged
