"""Predictions of several tiles at the same points, blended."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray


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
            Their indices, shape (K,).
        share
            Of the tile in each, shape (K,) or longer.
        values
            Field (K, 3) in uT and gradient (K, 3, 3) in uT/m.
        """
        add_shares(rows, share, *values, self.field, self.gradient)


@njit(cache=True, nogil=True)
def add_shares(
    rows: IntArray,
    share: FloatArray,
    part_field: FloatArray,
    part_gradient: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add what one tile predicts, times its share, to the rows of field and gradient."""
    for n in range(len(rows)):
        for i in range(3):
            field[rows[n], i] += share[n] * part_field[n, i]
            for j in range(3):
                gradient[rows[n], i, j] += share[n] * part_gradient[n, i, j]
