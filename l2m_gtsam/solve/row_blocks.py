"""A tall matrix of many rows that know little of each other, in products as fast as dense ones.

Readings of one place follow the same few hundred of thousands of variables: of some rows in order
most columns are zero, and nearly all others full. Sparse products of such a matrix take up to
thirty times as long as those of its full blocks, and as a whole it would not fit into memory.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.solve.linear_algebra import add_upper

ROWS = 192  # of a block: enough for a fast product, few enough to be of one place


@dataclass(frozen=True)
class RowBlock:
    """Some rows in order.

    Attributes
    ----------
    rows
        Which.
    columns
        Where they are not zero, k of them, in order.
    values
        There, shape (m, k).
    """

    rows: slice
    columns: IntArray
    values: FloatArray


@dataclass(frozen=True)
class RowBlocks:
    """A matrix, shape (m, n).

    Attributes
    ----------
    blocks
        All of its rows in order.
    width
        n.
    """

    blocks: tuple[RowBlock, ...]
    width: int

    @classmethod
    def of(cls, matrix: csr_array | FloatArray) -> "RowBlocks":
        """Return a matrix in blocks."""
        blocks = tuple(_block(matrix, rows) for rows in _slices(matrix.shape[0]))
        return cls(blocks, matrix.shape[1])

    def toarray(self) -> FloatArray:
        """Return the matrix as it is, shape (m, n)."""
        return self @ np.eye(self.width)

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """Return the product with x, shape (n,) or (n, k)."""
        return np.concatenate([each.values @ x[each.columns] for each in self.blocks])

    def transposed_times(self, y: csr_array | FloatArray) -> FloatArray:
        """Return the product of the transposed matrix with y, shape (m,) or (m, k)."""
        product = np.zeros((self.width, *y.shape[1:]))
        for each in self.blocks:
            product[each.columns] += each.values.T @ y[each.rows]
        return product

    def gram(self) -> FloatArray:
        """Return the product of the transposed matrix with the matrix, shape (n, n)."""
        upper = np.zeros((self.width, self.width))
        for each in self.blocks:
            add_upper(upper, each.columns, each.values.T @ each.values)
        return np.asarray(upper + np.triu(upper, 1).T)

    def beside(self, columns: csr_array | FloatArray) -> "RowBlocks":
        """Return the matrix with more columns, shape (m, k)."""
        blocks = []
        for each in self.blocks:
            more = _block(columns, each.rows)
            wider = np.concatenate([each.columns, self.width + more.columns])
            blocks.append(RowBlock(each.rows, wider, np.hstack([each.values, more.values])))
        return RowBlocks(tuple(blocks), self.width + columns.shape[1])

    def at(self, rows: IntArray) -> "RowBlocks":
        """Return some rows, in order."""
        blocks, first = [], 0
        for each in self.blocks:
            begin, end = np.searchsorted(rows, [each.rows.start, each.rows.stop])
            if begin == end:
                continue
            last = first + int(end - begin)
            own = each.values[rows[begin:end] - each.rows.start]
            blocks.append(RowBlock(slice(first, last), each.columns, own))
            first = last
        return RowBlocks(tuple(blocks), self.width)


def _slices(rows: int) -> Iterator[slice]:
    for first in range(0, max(rows, 1), ROWS):
        yield slice(first, min(first + ROWS, rows))


def _block(matrix: csr_array | FloatArray, rows: slice) -> RowBlock:
    """Return rows of a matrix in the columns in which they are not all zero."""
    own = matrix[rows]
    values = np.asarray(own.toarray() if isinstance(own, csr_array) else own)
    at = np.flatnonzero(values.any(axis=0))
    return RowBlock(rows, at, values if len(at) == values.shape[1] else values[:, at])
