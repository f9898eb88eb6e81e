"""Rows and columns of a large matrix that a few readings touch: added to, taken out, multiplied.

NumPy's indexing by two lists of places takes 40 ns for an element that is added. Where thousands of
groups of readings touch dozens to hundreds of variables each, that was a fifth of a calibration's
last stage.
"""

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray


@njit(cache=True, nogil=True)
def add_upper(matrix: FloatArray, at: IntArray, block: FloatArray) -> None:
    """Add a symmetric block to the upper triangle of a symmetric matrix.

    Parameters
    ----------
    matrix
        Shape (n, n); below its diagonal nothing is written.
    at
        Rows and columns of the block in the matrix, each once, in any order, shape (k,).
    block
        Shape (k, k).
    """
    for i in range(len(at)):
        row = at[i]
        for j in range(len(at)):
            column = at[j]
            if column >= row:
                matrix[row, column] += block[i, j]


@njit(cache=True, nogil=True)
def upper_product(matrix: FloatArray, at: IntArray, block: FloatArray) -> float:
    """Return the sum over the upper triangle of a matrix of its elements times those of a block.

    Parameters are those of ``add_upper``.
    """
    total = 0.0
    for i in range(len(at)):
        row = at[i]
        for j in range(len(at)):
            column = at[j]
            if column >= row:
                total += matrix[row, column] * block[i, j]
    return total


@njit(cache=True, nogil=True)
def submatrix(matrix: FloatArray, at: IntArray) -> FloatArray:
    """Return the rows and columns ``at`` of a matrix, in their order, shape (k, k)."""
    found = np.empty((len(at), len(at)))
    for i in range(len(at)):
        row = at[i]
        for j in range(len(at)):
            found[i, j] = matrix[row, at[j]]
    return found
