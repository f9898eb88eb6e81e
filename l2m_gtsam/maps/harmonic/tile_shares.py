"""Which tiles have a share in a place: that it lies in and, near a border, its neighbours."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.grid import Grid

MOST = 4  # tiles that have a share in one place: bands are at most half a core wide


@dataclass(frozen=True)
class TilePoints:
    """Points that one tile has a share in.

    Attributes
    ----------
    tile
        Index of the tile in the grid, counted from 0.
    rows
        Indices of the points, shape (K,).
    share
        Weight of the tile in the blend at each point, shape (K,); over all tiles they sum to one.
    """

    tile: int
    rows: IntArray
    share: FloatArray


def shares_of(
    points: FloatArray, grid: Grid, blend: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return rows of points, tiles, and shares that add up to one over a point's tiles.

    A point far from all tiles comes once, with the tile -1.

    Parameters
    ----------
    points
        Metres, shape (N, 3).
    grid
        Cores of the tiles in x and y of the map frame, metres.
    blend
        Half the width in metres of the band in which neighbours blend.
    """
    rows, tiles = np.empty((2, MOST * len(points)), dtype=np.int64)
    share = np.empty(MOST * len(points))
    bounds = np.stack([grid.cells.min(axis=0), grid.cells.max(axis=0)])
    count = write_shares(
        points, grid.origin, grid.size, grid.cells, bounds, blend, rows, tiles, share
    )
    return rows[:count], tiles[:count], share[:count]


@njit(cache=True, nogil=True)
def write_shares(
    points: FloatArray,
    origin: FloatArray,
    size: float,
    cells: IntArray,
    bounds: IntArray,
    blend: float,
    rows: IntArray,
    tiles: IntArray,
    share: FloatArray,
) -> int:
    """Write rows, tiles and shares of ``shares_of`` and return how many there are.

    ``bounds`` has the lowest and the highest cell along each axis, shape (2, 2).
    """
    own, along = np.empty((2, 2), dtype=np.int64), np.empty((2, 2))
    last = np.zeros((2, 2), dtype=np.int64)  # places that follow each other are in the same cells
    per_size, per_width = 1 / size, 0.5 / blend
    count = 0
    for n in range(len(points)):
        for axis in range(2):
            place = (points[n, axis] - origin[axis]) * per_size
            # Far away there is no tile: clipping keeps the cell's number an integer.
            place = min(max(place, bounds[0, axis] - 2.0), bounds[1, axis] + 3.0)
            own[axis, 0] = int(np.floor(place))
            own[axis, 1] = own[axis, 0] + (1 if place - own[axis, 0] >= 0.5 else -1)
            for side in range(2):
                centre = origin[axis] + (own[axis, side] + 0.5) * size
                away = abs(points[n, axis] - centre) - 0.5 * size
                along[axis, side] = ramp(0.5 - away * per_width)
        first, total = count, 0.0
        for i in range(2):
            for j in range(2):
                product = along[0, i] * along[1, j]
                if product == 0:
                    continue
                tile = last[i, j]
                if cells[tile, 0] != own[0, i] or cells[tile, 1] != own[1, j]:
                    tile = index_of(cells, own[0, i], own[1, j])
                    if tile < 0:
                        continue
                    last[i, j] = tile
                rows[count], tiles[count], share[count] = n, tile, product
                total += product
                count += 1
        for each in range(first, count):
            # At the rim of the map some of the four neighbours are missing.
            share[each] /= total
        if count == first:
            rows[count], tiles[count], share[count] = n, -1, 1.0
            count += 1
    return count


@njit(cache=True, nogil=True)
def ramp(within: float) -> float:
    """Return a share along one axis, twice differentiable, at a fraction of the band's width."""
    # The shortest polynomial from 0 to 1 whose first and second derivatives vanish at both ends:
    # a blended gradient has no kink that a solver's steps could catch on.
    r = min(max(within, 0.0), 1.0)
    return float(r * r * r * (10 + r * (6 * r - 15)))


@njit(cache=True, nogil=True)
def index_of(cells: IntArray, x: int, y: int) -> int:
    """Return which of the cells, in lexical order, shape (B, 2), this one is, or -1."""
    low, high = 0, len(cells)
    while low < high:
        middle = (low + high) // 2
        if cells[middle, 0] < x or (cells[middle, 0] == x and cells[middle, 1] < y):
            low = middle + 1
        else:
            high = middle
    if low < len(cells) and cells[low, 0] == x and cells[low, 1] == y:
        return low
    return -1


@dataclass(frozen=True)
class Blend:
    """Sums of the tiles' predictions, each times its share: normalised once every tile is added.

    Attributes
    ----------
    field
        In microtesla, shape (N, 3).
    gradient
        In uT/m, shape (N, 3, 3).
    """

    field: FloatArray
    gradient: FloatArray

    @classmethod
    def of(cls, count: int) -> "Blend":
        """Return the sums over no tiles yet, of this many points."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3, 3)))

    def add(self, rows: IntArray, share: FloatArray, values: tuple[FloatArray, FloatArray]) -> None:
        """Add what one tile predicts at some points.

        Parameters
        ----------
        rows
            Their indices, none twice, shape (K,).
        share
            Of the tile in each, shape (K,).
        values
            Field (K, 3) in uT and gradient (K, 3, 3) in uT/m.
        """
        field, gradient = values
        self.field[rows] += share[:, None] * field
        self.gradient[rows] += share[:, None, None] * gradient
