"""Points merged cell by cell of a grid."""

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray

# Points that wait before they are merged, at least.
BATCH_POINTS = 1 << 18
# A cell's three indices are packed into one number, counted from the first point's cell.
BITS = 20
REACH_CELLS = 1 << BITS


class VoxelMeans:
    """The mean of the points in every cell of a grid, of points that come piece by piece.

    Memory grows with the cells that hold points, not with the points.

    Parameters
    ----------
    edge
        Side of the cubic cells in metres, positive; the origin is a corner of a cell.
    """

    def __init__(self, edge: float) -> None:
        self._edge = edge
        self._origin: IntArray | None = None
        # One row per cell, in order of the keys: sums of x, y and z, number of points.
        self._keys = np.zeros(0, dtype=np.int64)
        self._sums = np.zeros((0, 4))
        self._waiting: list[FloatArray] = []
        self._number_waiting = 0

    def __len__(self) -> int:
        """Return the cells known so far; points that wait to be merged are not in it."""
        return len(self._keys)

    def add(self, points: FloatArray) -> None:
        """Add finite points, shape (N, 3) in metres.

        Raises
        ------
        ValueError
            A point is more than a million cells away from the first one.
        """
        self._waiting.append(points)
        self._number_waiting += len(points)
        # Merging sorts all cells: seldom enough that its cost per point does not grow.
        if self._number_waiting > max(BATCH_POINTS, len(self)):
            self._merge()

    def points(self) -> FloatArray:
        """Return one point per cell that has any, in order of the cells, shape (M, 3) in metres.

        Raises
        ------
        ValueError
            As in `add`.
        """
        self._merge()
        return np.asarray(self._sums[:, :3] / self._sums[:, 3:])

    def _merge(self) -> None:
        points = np.concatenate([np.zeros((0, 3)), *self._waiting])
        self._waiting, self._number_waiting = [], 0
        if not len(points):
            return
        sums = np.concatenate([self._sums, np.column_stack([points, np.ones(len(points))])])
        keys = np.concatenate([self._keys, self._keys_of(points)])
        self._keys, cell = np.unique(keys, return_inverse=True)
        self._sums = np.column_stack([np.bincount(cell, column) for column in sums.T])

    def _keys_of(self, points: FloatArray) -> IntArray:
        """Return one number per point that tells cells apart, shape (N,)."""
        cells = np.floor(points / self._edge).astype(np.int64)
        if self._origin is None:
            self._origin = cells[0]
        steps = cells - self._origin
        if np.abs(steps).max() >= REACH_CELLS:
            reach = REACH_CELLS * self._edge
            raise ValueError(
                f"it has points more than {reach:.3g} m apart, too far for cells of "
                f"{self._edge:g} m; remove those that are astray"
            )
        x, y, z = (steps + REACH_CELLS).T
        return np.asarray((x << 2 * BITS + 2) | (y << BITS + 1) | z)
