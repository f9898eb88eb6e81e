"""Tiles: how large they are, where they lie, how they blend, and which represent a survey."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.grid import Grid, grid_over
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR
from l2m_gtsam.maps.harmonic.tile_shares import TilePoints, shares_of
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.options import Options
from l2m_gtsam.solve.linear_algebra import parts_of

# Modes per square metre of box and squared wave number: a quarter of a disc of half waves.
MODE_DENSITY = 1 / (4 * np.pi)
WAVE_NUMBERS = (0.5, 60.0)  # 1/m: from a tile's longest wave to one of a decimetre
FINER = 1.3  # finer waves by less than this are not worth learning anew or smaller tiles
LEAST_CORE = 1.0  # metres
FILL = 0.15  # metres; cells of this edge with a reading make the surveyed area
FEWEST = 12  # readings, three for each coefficient of a linear field


class TilingOptions(Options):
    """The surroundings of a tile's core, in metres."""

    overlap: float = Field(default=0.5, gt=0)
    """Readings this far around the core take part in a tile."""
    margin: float = Field(default=0.75, gt=0)
    """The box reaches this far beyond its readings: the waves have no slope at its walls, where
    the field knows nothing of them."""


@dataclass(frozen=True)
class Resolution:
    """Largest wave numbers of floor and ceiling modes in 1/m."""

    floor: float
    ceiling: float

    def modes(self, edge: float) -> float:
        """Return about how many modes a square box of this edge in metres has."""
        return MODE_DENSITY * edge**2 * (self.floor**2 + self.ceiling**2)

    def within(self, modes: float, edge: float) -> "Resolution":
        """Return it with the shortest waves left out, of whichever side, down to so many modes.

        Which side's sources are the stronger and the nearer does not count: with few modes that is
        not learnt well. If both sides lost in proportion, the side that is taken for the nearer
        would keep nearly all of its waves, and what the other's would have held would go to it and
        to the noise, so that the next round takes it for nearer still.
        """
        squares = modes / (MODE_DENSITY * edge**2)
        coarser = min(self.floor, self.ceiling)
        most = float(np.sqrt(max(squares / 2, squares - coarser**2)))
        return Resolution(min(self.floor, most), min(self.ceiling, most))


def resolution_of(hyperparameters: Hyperparameters, density: float, share: float) -> Resolution:
    """Return which modes readings of a density carry information on.

    A mode's prior variance over the variance with which the readings alone would determine it is
    ``4 pi s^2 (2h)^3 k exp(-2 k h) density / sigma^2``, at the height of the lowest (highest)
    reading. It falls with k; modes are kept as long as it exceeds ``share``.

    Parameters
    ----------
    hyperparameters
        Scales and noise in uT, depths in metres.
    density
        Readings per square metre.
    share
        Ratio below which a mode is left out.
    """
    limits = []
    for side in (FLOOR, CEILING):
        s = getattr(hyperparameters, f"{side}_scale")
        h = getattr(hyperparameters, f"{side}_depth")
        gain = 4 * np.pi * s**2 * (2 * h) ** 3 * density / (hyperparameters.noise**2 * share)
        limits.append(_last_above_one(np.log(gain), h))
    return Resolution(*limits)


def _last_above_one(log_gain: float, h: float) -> float:
    """Return the largest k with ``log_gain + log k - 2 k h >= 0``, within sensible limits."""
    low, high = WAVE_NUMBERS

    def excess(k: float) -> float:
        return float(log_gain + np.log(k) - 2 * k * h)

    top = float(np.clip(1 / (2 * h), low, high))  # where it is largest
    if excess(top) <= 0:
        return low
    return high if excess(high) >= 0 else float(brentq(excess, top, high))


def finest(needed: Sequence[Resolution]) -> Resolution:
    """Return the first resolution, or the finest where that is finer by more than a little."""
    most = Resolution(max(each.floor for each in needed), max(each.ceiling for each in needed))
    return Resolution(
        most.floor if most.floor > FINER * needed[0].floor else needed[0].floor,
        most.ceiling if most.ceiling > FINER * needed[0].ceiling else needed[0].ceiling,
    )


def affordable(resolution: Resolution, options: TilingOptions, budget: int) -> Resolution:
    """Return the resolution, coarser where the smallest tile would have more modes than allowed.

    What is left out, the shortest waves of whichever side, counts as variance.
    """
    smallest = LEAST_CORE + 2 * (options.overlap + options.margin)
    return resolution.within(budget, smallest)


def surveyed_area(points: FloatArray) -> float:
    """Return the horizontal area in square metres in which there are readings."""
    cells = np.unique(np.floor(points[:, :2] / FILL).astype(np.int64), axis=0)
    return len(cells) * FILL**2


@dataclass(frozen=True)
class Tiling:
    """The tiles of a map.

    Attributes
    ----------
    grid
        Cores of the tiles in x and y of the map frame, metres.
    overlap
        Readings this far around a tile's core take part in it, metres.
    margin
        How far its box reaches beyond those readings in metres.
    blend
        Half the width in metres of the band in which neighbours blend; at most half a core, so
        that a point has no more than two neighbours along an axis.
    """

    grid: Grid
    overlap: float
    margin: float
    blend: float

    def __len__(self) -> int:
        return len(self.grid)

    @property
    def edge(self) -> float:
        """Edge of a tile's box in metres."""
        return self.grid.size + 2 * (self.overlap + self.margin)

    @property
    def parts(self) -> int:
        """Number of parts of the survey that are further apart than a tile."""
        cells = self.grid.cells
        touching = cKDTree(cells).query_pairs(1.5, output_type="ndarray")
        return int(parts_of(touching, len(cells)).max()) + 1

    def by_tile(self, points: FloatArray) -> list[TilePoints]:
        """Return which tiles have a share in which points; far from all of them the nearest has.

        Parameters
        ----------
        points
            Metres, shape (N, 3).
        """
        rows, tiles, share = shares_of(points, self.grid, self.blend)
        lonely = np.flatnonzero(tiles < 0)
        if len(lonely):
            tiles[lonely] = self.grid.block_of(points[rows[lonely]])
        # Of 16 bits: sorted in linear time; a grid has fewer blocks than that holds.
        order = np.argsort(tiles.astype(np.uint16), kind="stable")
        rows, tiles, share = rows[order], tiles[order], share[order]
        edges = np.flatnonzero(np.diff(tiles, prepend=-1, append=-1)).tolist()
        return [
            TilePoints(int(tiles[start]), rows[start:stop], share[start:stop])
            for start, stop in pairwise(edges)
        ]


def blend_of(core: float, options: TilingOptions) -> float:
    """Return half the width of the band in which tiles of this core blend, metres."""
    return min(0.25 * core, 0.5, options.overlap)


def tiling_of(
    points: FloatArray, resolution: Resolution, options: TilingOptions, budget: int, reach: float
) -> Tiling:
    """Return tiles as large as the number of weights allows, over all readings.

    Parameters
    ----------
    points
        Positions of the readings in metres, shape (N, 3).
    resolution
        Largest wave numbers to be kept in 1/m.
    options
        Overlap and margin of the tiles in metres.
    budget
        The most modes of one tile.
    reach
        How far from the readings tiles are needed, metres.
    """
    largest = np.sqrt(budget / resolution.modes(1.0)) - 2 * (options.overlap + options.margin)
    extent = float(np.ptp(points[:, :2], axis=0).max()) + 1e-6
    core = max(min(largest, extent), LEAST_CORE)
    if extent > core:  # equal tiles, the last as full as the first
        core = extent / np.ceil(extent / core) * (1 + 1e-9)
    blend = blend_of(core, options)
    # A tile whose core is further from all readings than the overlap would have none.
    grid = grid_over(points, core, min(reach, options.overlap, 0.49 * core))
    return Tiling(grid, options.overlap, options.margin, blend)


def spread_tiles(tiling: Tiling, members: Sequence[IntArray], number: int) -> list[int]:
    """Return tiles far from each other among those with many readings, by the rows of each."""
    counts = np.array([len(rows) for rows in members])
    rich = np.flatnonzero(counts >= np.median(counts))
    centres = tiling.grid.centres[rich]
    chosen = [int(np.argmax(counts[rich]))]
    away = np.full(len(rich), np.inf)
    while len(chosen) < min(number, len(rich)):
        away = np.minimum(away, np.linalg.norm(centres - centres[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(away)))
    return [int(rich[c]) for c in chosen]


def rough_tiles(
    readings: TrainingSet, members: Sequence[IntArray], number: int, besides: Sequence[int]
) -> list[int]:
    """Return tiles where the field is roughest, besides those that are looked at already.

    Steel is not spread evenly. A patch of it that no other tile shows is what a map knows least
    and would be most wrong about.

    Parameters
    ----------
    readings
        Readings of the whole survey, map frame, metres and uT.
    members
        Rows of the readings that take part in each tile.
    number
        How many are wanted; there may be fewer.
    besides
        Indices of tiles that are chosen already.
    """
    rough = np.array([roughness(readings[rows]) for rows in members])
    rough[list(besides)] = 0.0
    roughest = np.argsort(-rough, kind="stable")[:number]
    return [int(tile) for tile in roughest if rough[tile] > 0]


def roughness(readings: TrainingSet) -> float:
    """Return what a linear field leaves of the readings, root mean square in uT; 0 for a few."""
    if len(readings) < FEWEST:
        return 0.0
    away = readings.points - readings.points.mean(axis=0)
    linear = np.column_stack([np.ones(len(away)), away])
    fitted = np.linalg.lstsq(linear, readings.field, rcond=None)[0]
    return float(np.sqrt(np.mean((readings.field - linear @ fitted) ** 2)))
