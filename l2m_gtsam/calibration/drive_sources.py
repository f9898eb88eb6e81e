"""Steel that a drive shows beside a map: what changed since the survey, and what that missed."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.calibration.causes import changed_sources
from l2m_gtsam.calibration.missed_steel import missed_by_map
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.maps.sources.found_sources import FoundSources, price, refined
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources
from l2m_gtsam.records.places import ChangedSource


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
