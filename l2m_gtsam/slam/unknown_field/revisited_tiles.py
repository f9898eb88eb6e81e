"""Tiles at an estimate of poses: whether later visits find the field of earlier ones.

Where they do not, steel was moved between them: as few sources as explain what tiles differ by.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.sparse import csr_array

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.sources.found_sources import FoundSources
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.map_prediction import place_readings
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.changed_visits import Seen, VisitResiduals, trusted
from l2m_gtsam.slam.unknown_field.tile_visits import (
    LIKELY,
    Change,
    Judged,
    JudgedVisits,
    Visit,
    middle_of,
)
from l2m_gtsam.slam.unknown_field.tiles import (
    Anchoring,
    FieldPrior,
    WaveTile,
    relative_place,
    visits_among,
)
from l2m_gtsam.slam.unknown_field.visit_graph import VisitGraph, ways_between
from l2m_gtsam.solve.linear_algebra import RowBlocks

KNOWN_M = 0.02  # standard deviation of a sensor's place, up to which tiles are judged
MOST_CHANGED = 0.6  # share of the visits to known tiles, beyond which none is believed to have
TIMES = 8  # the most times at which something is moved on a drive, and that visits are cut
READINGS = 40  # of a visit: more say little more of steel that is metres away


@dataclass(frozen=True)
class RenewedTiles:
    """Tiles whose field does not change.

    Attributes
    ----------
    anchoring
        The tile of each key pose.
    brought
        What steel that was moved adds to N readings in tiles that are kept, uT, in the sensors'
        frames, shape (N, 3).
    """

    anchoring: Anchoring
    brought: FloatArray


@dataclass(frozen=True)
class RevisitedTiles:
    """Tiles at an estimate of poses.

    Attributes
    ----------
    motions, poses, sensors, prior
        As for ``TiledDrive.renewed``.
    axes
        Level axes of the key poses in the map, shape (K, 3, 3).
    """

    motions: RelativeMotions
    poses: list[gtsam.Pose3]
    sensors: KnownSensors
    prior: FieldPrior
    axes: FloatArray

    def renewed(self, anchoring: Anchoring) -> RenewedTiles:
        """Return the same with a tile of its own from each visit on that found another field.

        Steel that was moved changes other tiles, too. One that was visited before and after a
        tile changed clearly needs little evidence to end there; so it does where what the moved
        steel adds is known worse than a reading. Else that is taken off its later readings.

        Where most visits find another field, none is believed to: that is how it looks from poses
        that are further off than a field is linear over, and where tiles do not hold the field.
        """
        brought = np.zeros_like(self.motions.readings.field)
        # Sensors at places that are not known find other fields from visit to visit, too.
        t = np.diagonal(self.sensors.covariance, axis1=-2, axis2=-1)[..., :3]
        if np.sqrt(t.max()) > KNOWN_M:
            return RenewedTiles(anchoring, brought)
        visits, new = self._visits(anchoring), frozenset[int]()
        for _ in range(TIMES):
            judged = JudgedVisits.of(visits, self._graph(visits), new)
            change = judged.first_change()
            if change is None or (not new and judged.changed > MOST_CHANGED):
                break
            cut = judged.cut(change)
            if cut is not None:
                visits = self._cut(visits, cut, anchoring)
                continue
            moved = moved_steel(judged, change)
            after = judged.after(moved.change)
            places = {k: self._in_map(anchoring, visits[k]) for k in after}
            ends = {
                k
                for k in after
                if judged.visits[k].gain > LIKELY or moved.sigma(places[k]) > self._noise
            }
            new |= {visits[k].begun for k in ends}
            for k in since(visits, [k for k in after if k not in ends]):
                R = self.poses[anchoring.anchor[visits[k].tile]].rotation().matrix()
                field = moved.sources.field(self._in_map(anchoring, visits[k]))
                visits[k] = visits[k].without(field @ R)
                rows = np.flatnonzero(np.isin(self._key_pose, visits[k].key_poses))
                brought[rows] += self._read(rows, moved.sources)
        ended = [each for each in visits if each.begun in new]
        return RenewedTiles(divided(anchoring, ended), brought)

    def _cut(self, visits: list[Visit], at: int, anchoring: Anchoring) -> list[Visit]:
        """Return visits, the one that a key pose is in as two: before that and from there on."""
        cut = list[Visit]()
        for each in visits:
            origin = self.poses[anchoring.anchor[each.tile]]
            cut += (
                [
                    replace(part, T_anchor_node=origin.between(self.poses[part.middle]))
                    for part in each.parts(at)
                    if len(part.seen)
                ]
                if at in each.key_poses
                else [each]
            )
        return cut

    def _graph(self, visits: list[Visit]) -> VisitGraph:
        at = [each.middle for each in visits]
        nodes = tuple(self.poses[k] for k in at)
        return VisitGraph(nodes, ways_between(self.motions.odometry, at))

    def _in_map(self, anchoring: Anchoring, visit: Visit) -> FloatArray:
        """Return where a visit's readings are in the map, shape (n, 3)."""
        T = self.poses[anchoring.anchor[visit.tile]]
        return np.asarray(visit.seen.points @ T.rotation().matrix().T + T.translation())

    @property
    def _noise(self) -> float:
        return float(np.median(self.sensors.noise))

    def _read(self, rows: IntArray, sources: FoundSources) -> FloatArray:
        """Return what n readings read of sources in the map, uT, shape (n, 3)."""
        readings = self.motions.readings[rows]
        where = place_readings(readings, self.poses, self.sensors)
        b_lidar = np.einsum("nji,nj->ni", where.readings.R_map_lidar, sources.field(where.x))
        return np.asarray(np.einsum("nij,nj->ni", where.C, b_lidar))

    def _visits(self, anchoring: Anchoring) -> list[Visit]:
        """Return all visits with readings, in the order of time."""
        visits = list[Visit]()
        for number, anchor in enumerate(anchoring.anchor.tolist()):
            own = np.flatnonzero(anchoring.tile == number)
            parts = [own[visit] for visit in visits_among(own)]
            rows = [np.flatnonzero(np.isin(self._key_pose, each)) for each in parts]
            found = [(part, each) for part, each in zip(parts, rows, strict=True) if len(each)]
            if found:
                visits += self._of_tile(number, anchor, found)
        return sorted(visits, key=lambda each: each.middle)

    def _of_tile(
        self, number: int, anchor: int, found: list[tuple[IntArray, IntArray]]
    ) -> list[Visit]:
        every = np.concatenate([rows for _, rows in found])
        where = relative_place(self.motions.readings[every], self.poses, anchor, self.sensors)
        R = self.poses[anchor].rotation().matrix()
        field = WaveTile.about(self.prior, R.T @ self.axes[anchor], where.x)
        noise = self.sensors.noise[self.motions.readings.sensor[every], None]
        variance, b = noise**2 + field.unresolved(where.x), where.field(self.sensors)
        visits, first = [], 0
        for key_poses, rows in found:
            own = slice(first, first + len(rows))
            first += len(rows)
            seen = Seen(where.x[own], b[own], variance[own], self._key_pose[rows])
            if len(found) > 1:
                seen = trusted(field, seen)
            node = self.poses[anchor].between(self.poses[middle_of(key_poses)])
            visits.append(Visit(number, key_poses, field, node, seen))
        return visits

    @property
    def _key_pose(self) -> IntArray:
        return np.asarray(self.motions.readings.key_pose)


def since(visits: list[Visit], first: list[int]) -> list[int]:
    """Return the numbers of all visits of some tiles from one of each on."""
    begun = {visits[k].tile: k for k in first}
    return [k for k, each in enumerate(visits) if k >= begun.get(each.tile, len(visits))]


def divided(anchoring: Anchoring, new: list[Visit]) -> Anchoring:
    """Return tiles with another one from each of some visits on."""
    anchors, tile = anchoring.anchor.tolist(), anchoring.tile.copy()
    for visit in new:
        later = (anchoring.tile == visit.tile) & (np.arange(len(tile)) >= visit.key_poses[0])
        tile[later] = len(anchors)
        anchors.append(int(visit.key_poses[0]))
    return Anchoring(np.array(anchors), tile)


@dataclass(frozen=True)
class MovedSteel:
    """What was moved, and when.

    Attributes
    ----------
    sources
        That came or went, in the map.
    change
        When, as closely as it is known with them.
    """

    sources: FoundSources
    change: Change

    def sigma(self, points: FloatArray) -> float:
        """Return the standard deviation of their field at points in the map, uT, (n, 3), rms."""
        if not len(self.sources):
            return 0.0
        J = np.concatenate([each.derivatives(points) for each in self.sources.shapes], axis=2)
        return float(np.sqrt(np.mean(np.sum((J @ self.sources.root) ** 2, axis=2))))


def moved_steel(judged: JudgedVisits, change: Change) -> MovedSteel:
    """Return sources that came or went at the time of a change.

    Parameters
    ----------
    judged
        Visits to known tiles.
    change
        When it was, as tiles that changed clearly show it.
    """
    after = judged.after(change)
    found = np.array([judged.visits[k].gain > LIKELY for k in after])
    rows = change_rows(judged, after)
    sources = find_sources(rows, rows.points[found[rows.slot]], SourceSearchOptions(), None)
    between = judged.during(change)
    if not (len(sources) and between):
        return MovedSteel(sources, change)
    # The later of the visits between may show the sources: from which one on is likeliest?
    rows = change_rows(judged, between)
    field, middle = sources.field(rows.points), [judged.visits[k].visit.middle for k in between]
    times = [change.begin, *middle, change.end]
    left = [
        rows.pull(rows.residual - field * (rows.slot >= first)[:, None])[1]
        for first in range(len(between) + 1)
    ]
    first = int(np.argmin(left))
    return MovedSteel(sources, Change(times[first], times[first + 1]))


def change_rows(judged: JudgedVisits, numbers: tuple[int, ...]) -> MarginalRows:
    """Return what visits differ from the earlier field by; each is a slot.

    Where they were is known by all others.
    """
    visits = judged.visits
    links = {k: (each.first, each.motion) for k, each in visits.items() if k not in numbers}
    mean, covariance = judged.graph.solved(links).motions({k: visits[k].first for k in numbers})
    means = mean.reshape(-1, POSE)
    parts = [_rows_of(visits[k], judged.graph, means[n]) for n, k in enumerate(numbers)]
    points, residual, whitening, nuisance = (list(each) for each in zip(*parts, strict=True))
    return MarginalRows(
        np.concatenate(points),
        np.concatenate(residual),
        csr_array(block_diag(*whitening)),
        RowBlocks.of(block_diag(*nuisance)),
        np.asarray(np.linalg.inv(covariance), dtype=np.float64),
        np.repeat(np.arange(len(numbers)), [len(each) for each in points]),
    )


def _rows_of(
    judged: Judged, graph: VisitGraph, mean: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return places and residuals of a visit in the map, their whitening and white derivatives."""
    visit, seen = judged.visit, judged.visit.seen.thinned(READINGS)
    own = VisitResiduals.of(visit.field, judged.earlier, seen, visit.T_anchor_node)
    # A tile moves with the first visit of it.
    T_map_anchor = graph.nodes[judged.first].compose(judged.T_anchor_first.inverse())
    R, p = T_map_anchor.rotation().matrix(), T_map_anchor.translation()
    F = own.features.reshape(3 * len(seen), -1) @ judged.earlier.axes
    spread = (F * judged.earlier.variance) @ F.T + np.diag(seen.variance.ravel())
    lower = cholesky(spread, lower=True)
    D = own.by_motion.reshape(-1, POSE)
    turned = np.kron(np.eye(len(seen)), R.T)
    return (
        seen.points @ R.T + p,
        (own.left - own.by_motion @ mean) @ R.T,
        solve_triangular(lower, turned, lower=True),
        solve_triangular(lower, D, lower=True),
    )
