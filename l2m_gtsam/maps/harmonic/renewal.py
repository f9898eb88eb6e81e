"""A harmonic map after a drive through a place that may have changed.

Readings of earlier drives are given the field of steel that has come or gone since, so that all
are of one field. What is left between them and the new ones is a step of the field, tile by tile,
as large as makes the readings of both most likely: where there is none, all count alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.history import History
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.teaching import explained
from l2m_gtsam.maps.harmonic.tile_sums import kept_share, likeliest_step
from l2m_gtsam.maps.sources.source import UT_M3, SourceShape
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.records.map_diary import DatedChange, FadedStretch, MapDrive
from l2m_gtsam.records.places import ChangedSource

LEAST_SIZE_M = 0.06  # half of the extent that steel has at least
CHANGED_M = 0.4  # so near a change, structures are others since
BAR_NODES = 5  # along a bar
NOTED = 0.9  # of what earlier readings knew: a stretch that keeps less is told


@dataclass(frozen=True)
class DriveReadings:
    """What a drive of a calibrated vehicle read, in the frame of the map.

    Attributes
    ----------
    readings
        In metres and uT.
    suite
        What errors of its sensors do to them; absent where they count as exact.
    drive
        When it was.
    """

    readings: TrainingSet
    suite: SuiteErrors | None
    drive: MapDrive


def renewed(
    field_map: HarmonicMap, new: DriveReadings, changes: Sequence[DatedChange], survey: MapDrive
) -> HarmonicMap:
    """Return a map as a drive found the place.

    Parameters
    ----------
    field_map
        Before.
    new
        The drive.
    changes
        Steel that came or went before it, as the map is going to tell.
    survey
        When the map was surveyed, if it does not know of it.
    """
    options, before = field_map.options, field_map.learnt
    history = before.history or History.of_survey(len(before.readings), survey)
    learnt = replace(before, history=history)
    learnt = learnt.followed_by(new.readings, options, new.suite, new.drive)
    learnt = with_places(corrected(learnt, changes, len(before.readings)), changes)
    learnt = told(with_steps(learnt, new.readings.points), changes)
    known = explained(without_outdated(learnt, options), options)
    return HarmonicMap.condition(known, options).in_frame(field_map.frame)


def corrected(learnt: Learnt, changes: Sequence[DatedChange], count: int) -> Learnt:
    """Return the same, its first so many readings with the field of what changed after them."""
    field, points = learnt.readings.field.copy(), learnt.readings.points[:count]
    for change in changes:
        field[:count] += shape_of(change.source).field_and_gradient(points)[0]
    return replace(learnt, readings=replace(learnt.readings, field=field))


def shape_of(source: ChangedSource) -> SourceShape:
    """Return a source that changed as its field is made of it."""
    return SourceShape(np.concatenate([source.position, source.moment, source.half_axis]))


def with_places(learnt: Learnt, changes: Sequence[DatedChange]) -> Learnt:
    """Return the same with structures where steel came or went, and those there as others.

    What a source is beside its dipole, or its bar, is not what earlier readings were given: they
    tell nothing of structures that changed.
    """
    if not changes:
        return learnt
    middles, reach = learnt.sources.middles, []
    first, positions, numbers, strengths = len(learnt.strengths), [], [], []
    for k, change in enumerate(changes):
        source = change.source
        near = np.linalg.norm(middles - source.position, axis=1) < CHANGED_M + source.length_m / 2
        reach.append(np.flatnonzero(near))
        own = np.maximum(source.position_sigma, LEAST_SIZE_M)
        corners = np.vstack([np.zeros(3), np.diag(own), -np.diag(own)])
        nodes = np.linspace(-1, 1, BAR_NODES if source.length_m else 1)[:, None, None]
        places = (source.position + nodes * source.half_axis + corners).reshape(-1, 3)
        positions.append(places)
        numbers.append(np.full(len(places), first + k))
        size = UT_M3 * float(np.linalg.norm(source.moment)) / np.sqrt(3 * len(places))
        strengths.append(size / learnt.hyperparameters.structure_scale)
    sources = Sources(
        np.concatenate([learnt.sources.positions, *positions]),
        np.concatenate([learnt.sources.structure, *numbers]),
    )
    others = np.unique(np.concatenate([*reach, np.arange(first, first + len(changes))]))
    return replace(
        learnt,
        sources=sources,
        strengths=np.append(learnt.strengths, strengths),
        history=learnt.past.with_freed(others.astype(np.int64)),
    )


def with_steps(learnt: Learnt, points: FloatArray) -> Learnt:
    """Return the same with the steps of the tiles that new readings take part in."""
    grid = learnt.tiling.grid
    away, _ = cKDTree(points[:, :2]).query(grid.centres, p=np.inf)
    touched = np.flatnonzero(np.asarray(away) <= 0.5 * grid.size + learnt.tiling.overlap).tolist()
    steps = in_threads(lambda tile: likeliest_step(learnt, tile), touched)
    found = dict(zip(touched, steps, strict=True))
    return replace(learnt, history=learnt.past.with_steps(grid, found))


def told(learnt: Learnt, changes: Sequence[DatedChange]) -> Learnt:
    """Return the same with what changed in its diary, and where earlier readings count less."""
    history, grid = learnt.past, learnt.tiling.grid
    last, faded = history.drives - 1, []
    for tile, cell in enumerate(grid.cells):
        if history.steps_of(cell)[last].share > 0:
            kept = kept_share(learnt, tile)
            if kept < NOTED:
                x, y = grid.centres[tile].tolist()
                faded.append(FadedStretch((x, y), float(grid.size), last, kept))
    diary = history.diary
    diary = replace(diary, changes=(*diary.changes, *changes), faded=(*diary.faded, *faded))
    return replace(learnt, history=replace(history, diary=diary))


def without_outdated(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same without readings of which nothing is left: their tile moved altogether."""
    history, owner = learnt.past, learnt.tiling.grid.block_of(learnt.readings.points)
    since = np.array([outdated(history, cell) for cell in learnt.tiling.grid.cells])
    keep = history.drive >= since[owner]
    return learnt if keep.all() else learnt.only(keep, options)


def outdated(history: History, cell: IntArray) -> int:
    """Return the first drive of a tile that still says something."""
    steps = history.steps_of(cell)
    gone = [k for k, step in enumerate(steps) if step.share == 1 and step.depth == 0]
    return gone[-1] if gone else 0
