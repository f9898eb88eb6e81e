"""Steel that a drive shows beside a map: what changed since the survey, and what that missed.

A map keeps the readings of its survey. Where it does not explain them, as where it takes a box for
floor, a drive differs from it as if steel had come. With e what the survey's readings lack of the
map, b the field of a source that a drive shows and sigma the noise of a reading,

    sum (|e|^2 - |e - b|^2) / sigma^2

is twice the logarithm of the likelihood that the source stood there already over that it did not:
neither has parameters that the other has not. Steel that came or went since leaves -sum |b|^2 /
sigma^2, and where a source is beyond reach of the survey nothing is said.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.calibration.causes import changed_sources
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.maps.sources.found_sources import FoundSources, price, refined
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import REACH_M, SourceSearchOptions, find_sources
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.records.places import CLEAR, ChangedSource


@dataclass(frozen=True)
class DriveSources:
    """Sources that readings of a drive show beside a map.

    Attributes
    ----------
    rows, drive
        The readings; single wrong ones do not count.
    found
        K sources.
    missed
        Which of them the map's survey shows as well, shape (K,): they stood there already.
    """

    rows: MarginalRows
    drive: AveragedDrive
    found: FoundSources
    missed: BoolArray

    @property
    def gain(self) -> float:
        """What the sources explain, less what their parameters cost."""
        before = self.rows.pull(self.rows.residual)[1]
        return before - self.found.left - price(self.rows, self.found.parameters)

    @property
    def missed_places(self) -> FloatArray:
        """Where the map lacks steel, metres, shape (M, 3)."""
        return np.array([each.position for each in self.found.shapes])[self.missed]

    def changed(self) -> tuple[ChangedSource, ...]:
        """Return what came, went or was moved since the survey."""
        every = changed_sources(self.rows, self.drive, self.found)
        return tuple(each for each, was in zip(every, self.missed, strict=True) if not was)

    def of_changes(self) -> FoundSources:
        """Return the sources that changed, fitted without those that the map misses."""
        if not self.missed.any():
            return self.found
        pairs = zip(self.found.shapes, self.missed, strict=True)
        kept = refined(self.rows, tuple(shape for shape, was in pairs if not was))
        return replace(kept, gains=self.found.gains[~self.missed])


def drive_sources(
    rows: MarginalRows,
    drive: AveragedDrive,
    suspected: FloatArray,
    field_map: QueryableMap,
    options: SourceSearchOptions,
    known: FoundSources | None = None,
) -> DriveSources:
    """Return the sources that a drive shows.

    Parameters
    ----------
    rows, drive
        Its averaged readings.
    suspected
        Places near which sources may be, metres, shape (M, 3).
    field_map
        As it was surveyed.
    options
        How to look.
    known
        Sources that were found before, if any.
    """
    found = find_sources(rows, suspected, options, known)
    missed = missed_by_map(found.shapes, field_map)
    return DriveSources(rows.without(found.wrong), drive, found, missed)


def missed_by_map(shapes: Sequence[SourceShape], field_map: QueryableMap) -> BoolArray:
    """Return which sources the readings of a map's survey clearly show as well, shape (K,).

    None of a map that keeps no readings.

    Parameters
    ----------
    shapes
        Sources that a drive shows beside the map, K of them.
    field_map
        As it was surveyed.
    """
    if not shapes or not isinstance(field_map, Surveyed):
        return np.zeros(len(shapes), dtype=np.bool_)
    near = field_map.readings.tree.query_ball_point([each.position for each in shapes], REACH_M)
    read = field_map.readings[np.unique(np.concatenate([np.array(rows, int) for rows in near]))]
    if not len(read):
        return np.zeros(len(shapes), dtype=np.bool_)
    field, _ = field_map.field_and_gradient(read.points)
    lacking, weight = read.field - field, read.weight[:, None]
    variance = float(np.mean(weight * lacking**2))
    gains = []
    for shape in shapes:
        b, _ = shape.field_and_gradient(read.points)
        gains.append(float(np.sum(weight * b * (2 * lacking - b))))
    return np.array(gains) > CLEAR * variance
