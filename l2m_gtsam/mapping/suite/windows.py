"""Parts of a survey over which the sensors of its suite are looked at."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.mapping.suite.evidence import SuiteWindow, undistorted
from l2m_gtsam.mapping.suite.options import SuiteOptions
from l2m_gtsam.maps.harmonic.furnish import basis_of
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learning import LearningOptions, learn
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.representatives import spread_tiles
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES
from l2m_gtsam.maps.harmonic.tiling import (
    Tiling,
    affordable,
    resolution_of,
    surveyed_area,
    tiling_of,
)
from l2m_gtsam.maps.training import TrainingSet, merged, training_set


@dataclass(frozen=True)
class SuiteWindows:
    """Windows of a survey, each with readings of its own, and the prior of the field in them.

    Attributes
    ----------
    parts
        Windows.
    rows
        Which readings of the survey each has.
    prior
        Of the field, and the readings' noise.
    """

    parts: tuple[SuiteWindow, ...]
    rows: tuple[IntArray, ...]
    prior: Hyperparameters


def windows_over(readings: Readings, sensors: FloatArray, options: SuiteOptions) -> SuiteWindows:
    """Learn the prior of the field where sensors with these parameters saw it, and lay windows.

    Parameters
    ----------
    readings
        Of the survey, at the sensors' clocks.
    sensors
        Parameters of S sensors, shape (S, 16).
    options
        How many windows.

    Raises
    ------
    MapError
        There are too few readings.
    """
    seen, defaults = undistorted(readings, sensors), HarmonicOptions()
    raw = training_set(seen.points, seen.field)
    survey = merged(raw, defaults.merge, defaults.independent)
    learning = LearningOptions(windows=options.windows, rough=0, modes=options.modes)
    share = defaults.mode_share
    prior = learn(survey, NO_SOURCES, defaults.tiling, share, learning).hyperparameters
    density = float(survey.weight.sum()) / surveyed_area(survey.points)
    wanted = resolution_of(prior, density, share)
    resolution = affordable(wanted, defaults.tiling, learning.modes)
    tiling = tiling_of(survey.points, resolution, defaults.tiling, learning.modes, reach=0.0)
    parts, of = [], []
    for tile, rows in _dealt(tiling, seen.points, options):
        own = TrainingSet(seen.points[rows], seen.field[rows], np.ones(len(rows)))
        centre = tiling.grid.centres[tile]
        basis = basis_of(own, centre, tiling.edge, resolution, [], np.empty(0))
        parts.append(SuiteWindow(basis, own.points.mean(axis=0), readings[rows]))
        of.append(rows)
    return SuiteWindows(tuple(parts), tuple(of), prior)


def _dealt(tiling: Tiling, points: FloatArray, options: SuiteOptions) -> list[tuple[int, IntArray]]:
    """Return tiles spread over a survey, with readings of which none belongs to two of them."""
    members = tiling.grid.members(points, tiling.overlap)
    tiles = spread_tiles(tiling, [len(rows) for rows in members], options.windows)
    away = np.abs(points[:, None, :2] - tiling.grid.centres[tiles]).max(axis=2)
    nearest = np.argmin(away, axis=1)
    dealt = []
    for number, tile in enumerate(tiles):
        rows = members[tile][nearest[members[tile]] == number]
        some = np.linspace(0, len(rows) - 1, min(len(rows), options.readings)).astype(np.int64)
        dealt.append((tile, rows[some]))
    return [(tile, rows) for tile, rows in dealt if len(rows)]
