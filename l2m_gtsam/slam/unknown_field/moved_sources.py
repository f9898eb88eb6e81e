"""Steel that was moved between two visits: as few sources as explain what tiles differ by."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.sparse import csr_array

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.found_sources import FoundSources
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources
from l2m_gtsam.slam.unknown_field.changed_visits import VisitResiduals
from l2m_gtsam.slam.unknown_field.tile_visits import LIKELY, Change, Judged, JudgedVisits
from l2m_gtsam.slam.unknown_field.visit_graph import POSE, VisitGraph

READINGS = 40  # of a visit: more say little more of steel that is metres away


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
        csr_array(block_diag(*nuisance)),
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
