"""Parts of a survey whose readings calibrate its suite, and what describes the field in them."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_likelihood import SuiteWindow, undistorted
from l2m_gtsam.maps.harmonic.basis import COARSE, Basis, basis_of
from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.learning import LearningOptions, learn, maximise
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES, Sources
from l2m_gtsam.maps.harmonic.teaching import learn_map, learn_strengths
from l2m_gtsam.maps.harmonic.tiling import (
    Resolution,
    Tiling,
    affordable,
    resolution_of,
    spread_tiles,
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


def windows_over(
    readings: Readings, sensors: FloatArray, sources: Sources, options: SuiteCalibrationOptions
) -> SuiteWindows:
    """Learn the prior of the field from sensors with these parameters, and choose windows.

    Parameters
    ----------
    readings
        Of the survey, at the sensors' clocks.
    sensors
        Parameters of S sensors, shape (S, 16).
    sources
        Of steel beside the path, map frame, metres.
    options
        How many windows.

    Raises
    ------
    MapError
        There are too few readings.
    """
    undone, defaults = undistorted(readings, sensors), HarmonicOptions()
    raw = training_set(undone.points, undone.field)
    survey = merged(raw, defaults.merge, defaults.independent)
    learning = LearningOptions(windows=options.windows, rough=0, modes=options.modes)
    share = defaults.mode_share
    prior = learn(survey, sources, defaults.tiling, share, learning, maximise).hyperparameters
    density = float(survey.weight.sum()) / surveyed_area(survey.points)
    wanted = resolution_of(prior, density, share)
    resolution = affordable(wanted, defaults.tiling, learning.modes)
    tiling = tiling_of(survey.points, resolution, defaults.tiling, learning.modes, reach=0.0)
    parts, of = [], []
    for tile, rows in _dealt(tiling, undone.points, options):
        own = TrainingSet(undone.points[rows], undone.field[rows], np.ones(len(rows)))
        basis = _basis(own, tiling, tile, resolution, sources, prior)
        parts.append(SuiteWindow(basis, own.points.mean(axis=0), readings[rows]))
        of.append(rows)
    return SuiteWindows(tuple(parts), tuple(of), prior)


def _basis(
    own: TrainingSet,
    tiling: Tiling,
    tile: int,
    resolution: Resolution,
    sources: Sources,
    prior: Hyperparameters,
) -> Basis:
    """Return waves and sources of a window, each source as strong as its readings say."""
    centre, edge = tiling.grid.centres[tile], tiling.edge
    near = [sources.pieces[index] for index in sources.within(centre, edge)]
    even = basis_of(own, centre, edge, resolution, near, np.ones(len(near)), COARSE)
    strengths = np.array(learn_strengths(even, normal_of(even, own), prior))
    strong = np.flatnonzero(strengths > 0)
    pieces = [near[index] for index in strong]
    return basis_of(own, centre, edge, resolution, pieces, strengths[strong])


def sources_in(
    windows: SuiteWindows, sensors: FloatArray, options: SuiteCalibrationOptions
) -> Sources:
    """Return sources of steel that the readings of windows ask for; none if waves explain them.

    Waves come from below and above. Steel at the height of the path has a field that none of them
    makes; taken for one of the floor it has another slope along z, and sensors that are a few
    centimetres higher or lower, or a percent stronger along z, explain that.

    Parameters
    ----------
    windows
        With their readings at the sensors' clocks.
    sensors
        Shape (S, 16).
    options
        Size of the tiles.
    """
    undone = [undistorted(each.readings, sensors) for each in windows.parts]
    points, field = (
        np.concatenate([getattr(each, name) for each in undone]) for name in ("points", "field")
    )
    learning = LearningOptions(windows=options.windows, modes=options.modes)
    size = HarmonicOptions(learning=learning, modes=options.modes)
    return learn_map(training_set(points, field), NO_SOURCES, size).sources


def _dealt(
    tiling: Tiling, points: FloatArray, options: SuiteCalibrationOptions
) -> list[tuple[int, IntArray]]:
    """Return tiles spread over a survey, with readings of which none belongs to two of them."""
    members = tiling.grid.members(points, tiling.overlap)
    tiles = spread_tiles(tiling, members, options.windows)
    away = np.abs(points[:, None, :2] - tiling.grid.centres[tiles]).max(axis=2)
    nearest = np.argmin(away, axis=1)
    dealt = []
    for number, tile in enumerate(tiles):
        rows = members[tile][nearest[members[tile]] == number]
        some = np.linspace(0, len(rows) - 1, min(len(rows), options.readings)).astype(np.int64)
        dealt.append((tile, rows[some]))
    return [(tile, rows) for tile, rows in dealt if len(rows)]
