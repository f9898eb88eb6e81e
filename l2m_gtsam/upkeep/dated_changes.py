"""What happened to the steel that a drive shows beside a map: came, went or moved, and when."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.renewal import shape_of
from l2m_gtsam.maps.sources.source import UT_M3
from l2m_gtsam.records.map_diary import DatedChange, Happening, MapDiary
from l2m_gtsam.records.places import ChangedSource

# A source is detected where its field is as strong as this, and as this share of its strongest.
DETECTED_UT, DETECTED_SHARE = 0.2, 0.2
SAME_M, SAME_SHARE = 0.3, 0.3  # so near, and so alike, two sources are one
SIGMAS = 3.0
TAKEN = 0.3  # of its moment: what a map has of steel that went, at least
STEEL_M = 0.4  # so near a source stands the steel that it is of


def dated_changes(
    field_map: HarmonicMap, sources: Sequence[ChangedSource], diary: MapDiary
) -> tuple[DatedChange, ...]:
    """Return what happened to the sources of a drive that the map does not have yet.

    Parameters
    ----------
    field_map
        Before the drive.
    sources
        What the drive shows.
    diary
        What the map went through before.
    """
    drive, first = len(diary.drives), len(diary.changes)
    changes, came = [], Happening.CAME if has_cloud(field_map, diary) else Happening.EITHER
    for source in sources:
        brought = brought_by(source, diary.changes)
        gone = -float(standing_moment(field_map, source) @ source.moment)
        taken = gone > TAKEN * float(source.moment @ source.moment)
        what = Happening.WENT if brought is not None or taken else came
        before = last_detected(field_map, source)
        changes.append(DatedChange(what, source, drive, before, brought))
    return tuple(with_moves(changes, first))


def has_cloud(field_map: HarmonicMap, diary: MapDiary) -> bool:
    """Return whether a map knows where steel stood when it was surveyed.

    Without, steel that went and steel of the opposite moment that came are one and the same field.
    """
    return len(field_map.learnt.strengths) > len(diary.changes)


def last_detected(field_map: HarmonicMap, source: ChangedSource) -> int:
    """Return the last drive of a map that came to where a source is detected."""
    history, points = field_map.learnt.history, field_map.readings.points
    if history is None:
        return 0
    strength = np.linalg.norm(shape_of(source).field_and_gradient(points)[0], axis=1)
    detected = strength > max(DETECTED_UT, DETECTED_SHARE * float(strength.max()))
    return int(history.drive[detected].max(initial=0))


def brought_by(source: ChangedSource, changes: Sequence[DatedChange]) -> int | None:
    """Return the change that brought the steel which a source takes away; the last, if any."""
    gone = {each.other for each in changes if each.went}
    for number in reversed(range(len(changes))):
        each = changes[number]
        if not each.went and number not in gone and opposite(source, each.source):
            return number
    return None


def opposite(source: ChangedSource, brought: ChangedSource) -> bool:
    """Return whether a source is the opposite of one that was brought."""
    away = source.position - brought.position
    reach = SIGMAS * np.hypot(source.position_sigma, brought.position_sigma)
    left = source.moment + brought.moment
    sure = SIGMAS * np.hypot(source.moment_sigma, brought.moment_sigma)
    near = np.linalg.norm(away) <= SAME_M or bool((np.abs(away) <= reach).all())
    small = np.linalg.norm(left) <= SAME_SHARE * np.linalg.norm(brought.moment)
    return bool(near and (small or (np.abs(left) <= sure).all()))


def standing_moment(field_map: HarmonicMap, source: ChangedSource) -> FloatArray:
    """Return the moment of the steel that a map has where a source is, A m^2, shape (3,)."""
    learnt = field_map.learnt
    tile = field_map.tiles[int(learnt.tiling.grid.block_of(source.position[None])[0])]
    basis, total = tile.basis, np.zeros(3)
    at = basis.frame.localise(source.position[None])
    for columns, family in zip(basis.columns, basis.families, strict=True):
        if isinstance(family, Dipoles):
            moments = family.moments(tile.weights.mean[columns]) / UT_M3
            near = np.linalg.norm(family.positions - at, axis=1) <= STEEL_M
            total += moments[near].sum(axis=0)
    return np.asarray(basis.frame.R_map_tile @ total)


def with_moves(changes: list[DatedChange], first: int) -> list[DatedChange]:
    """Return changes of one drive, those that came with where they were taken from.

    Steel keeps the size of its moment when it is moved, though not its direction.

    Parameters
    ----------
    changes
        Of the drive.
    first
        Number of the first of them among all.
    """
    went = [k for k, each in enumerate(changes) if each.went]
    moved = []
    for change in changes:
        alike = [k for k in went if same_size(change.source, changes[k].source)]
        if not change.went and alike:
            went.remove(alike[0])
            change = replace(change, other=first + alike[0])
        moved.append(change)
    return moved


def same_size(one: ChangedSource, other: ChangedSource) -> bool:
    """Return whether two moments are of one size."""
    a, b = (float(np.linalg.norm(each.moment)) for each in (one, other))
    sure = SIGMAS * float(np.linalg.norm([one.moment_sigma, other.moment_sigma]))
    return abs(a - b) <= max(min(sure, 0.5 * max(a, b)), SAME_SHARE * max(a, b))
