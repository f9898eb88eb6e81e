"""Square blocks in x and y, columns in z, laid where there is data."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import MapError

MOST_BLOCKS = 20_000


@dataclass(frozen=True)
class Grid:
    """The blocks of a map and where they lie.

    Attributes
    ----------
    origin
        Lower corner of cell (0, 0) in metres, shape (2,).
    size
        Edge of a block in metres.
    cells
        Whole-numbered place of each block, in lexical order, shape (B, 2).
    """

    origin: FloatArray
    size: float
    cells: IntArray

    def __len__(self) -> int:
        return len(self.cells)

    @property
    def centres(self) -> FloatArray:
        """Centres of the blocks in metres, shape (B, 2)."""
        return self.origin + (self.cells + 0.5) * self.size

    @cached_property
    def _corners(self) -> tuple[IntArray, IntArray]:
        """The lowest and the highest cell in x and in y, each of shape (2,)."""
        return self.cells.min(axis=0), self.cells.max(axis=0)

    @cached_property
    def _strides(self) -> IntArray:
        lowest, highest = self._corners
        return np.array([highest[1] - lowest[1] + 3, 1])

    @cached_property
    def _names(self) -> IntArray:
        """A number for each block, in order, as the cells are, shape (B,)."""
        return np.asarray((self.cells - self._corners[0]) @ self._strides)

    def block_of(self, points: FloatArray) -> IntArray:
        """Return the block that answers for each point: its own, else the nearest, shape (N,).

        Parameters
        ----------
        points
            Metres, shape (N, 3).
        """
        block = self._own(points)
        outside = np.flatnonzero(block < 0)
        if len(outside):
            _, nearest = cKDTree(self.centres).query(points[outside, :2], p=np.inf)
            block[outside] = nearest
        return block

    def _own(self, points: FloatArray) -> IntArray:
        """Return the block in which each point lies, -1 if in none, shape (N,)."""
        lowest, highest = self._corners
        # To the middle of one cell more on each side, which is for all that is outside.
        nearest, furthest = (lowest - 0.5) * self.size, (highest + 1.5) * self.size
        along = np.clip(points[:, :2] - self.origin, nearest, furthest)
        cells = np.floor(along / self.size).astype(np.int64) - lowest
        names, wanted = self._names, cells @ self._strides
        found = np.minimum(np.searchsorted(names, wanted), len(names) - 1)
        return np.asarray(np.where(names[found] == wanted, found, -1))

    def members(self, points: FloatArray, margin: float) -> list[IntArray]:
        """Return the rows of the points in each block grown by a margin in metres."""
        tree = cKDTree(points[:, :2])
        found = tree.query_ball_point(self.centres, 0.5 * self.size + margin, p=np.inf)
        return [np.sort(np.asarray(rows, dtype=np.int64)) for rows in found]


def grid_over(points: FloatArray, size: float, reach: float) -> Grid:
    """Return the blocks of which some part is within reach of a point.

    Parameters
    ----------
    points
        Metres, shape (N, 3).
    size
        Edge of a block in metres.
    reach
        Metres; a square around each point is enough here, queries measure the distance.

    Raises
    ------
    MapError
        If there would be too many blocks.
    """
    return grid_from(points[:, :2].min(axis=0), points, size, reach)


def grid_from(origin: FloatArray, points: FloatArray, size: float, reach: float) -> Grid:
    """Return the blocks of ``grid_over`` counted from a given corner of cell (0, 0), metres."""
    own = np.unique(np.floor((points[:, :2] - origin) / size).astype(np.int64), axis=0)
    if len(own) > MOST_BLOCKS:
        raise MapError(
            f"map training readings fill {len(own)} blocks of {size:.3g} m, at most "
            f"{MOST_BLOCKS} are allowed: are the positions in metres?"
        )
    rings = int(np.ceil(reach / size))
    ring = np.arange(-rings, rings + 1)
    offsets = np.stack(np.meshgrid(ring, ring), axis=-1).reshape(-1, 2)
    grid = Grid(origin, size, np.unique((own[:, None] + offsets).reshape(-1, 2), axis=0))
    away, _ = cKDTree(points[:, :2]).query(grid.centres, p=np.inf)
    return replace(grid, cells=grid.cells[away <= 0.5 * size + reach])
