"""Small matrices that are kept in parts: symmetric gradients, and triangular roots."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg.blas import dgemm, dtrmm
from scipy.linalg.lapack import dtrtri

from l2m_gtsam.data import FloatArray

# Sums in any order and fused products: loops run in vector registers. What breaks NaN stays off.
FAST = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True, inline="always")
def add_symmetric(
    n: int,
    bx: float,
    by: float,
    bz: float,
    xx: float,
    yy: float,
    zz: float,
    xy: float,
    xz: float,
    yz: float,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add a field and its symmetric gradient to those of a point."""
    field[n, 0] += bx
    field[n, 1] += by
    field[n, 2] += bz
    gradient[n, 0, 0] += xx
    gradient[n, 1, 1] += yy
    gradient[n, 2, 2] += zz
    gradient[n, 0, 1] += xy
    gradient[n, 1, 0] += xy
    gradient[n, 0, 2] += xz
    gradient[n, 2, 0] += xz
    gradient[n, 1, 2] += yz
    gradient[n, 2, 1] += yz


BLOCK = 96  # rows: large enough for products of matrices, small beside the whole


class Block(NamedTuple):
    """Some rows of a factor K.

    Attributes
    ----------
    rows
        Rows of K in the block, b of them.
    before
        K left of the diagonal block, shape (b, rows.start), in Fortran order.
    inverse
        Inverse of the diagonal block, lower triangular, shape (b, b), in Fortran order.
    """

    rows: slice
    before: FloatArray
    inverse: FloatArray


@dataclass(frozen=True)
class TriangularFactor:
    """A lower triangular matrix K, shape (m, m), with its diagonal blocks inverted.

    LAPACK's own solve reaches half the speed of a product of matrices. Here all but the blocks on
    the diagonal are products, and those are inverted once.

    Attributes
    ----------
    size
        Number m of rows.
    values
        ``before`` and ``inverse`` of each block side by side in Fortran order, block after block,
        shape (``count(m)``,).
    """

    size: int
    values: FloatArray

    @classmethod
    def of(cls, K: FloatArray) -> "TriangularFactor":
        """Return the factor of a lower triangular matrix, shape (m, m)."""
        factor = cls(len(K), np.empty(count(len(K))))
        for rows, before, inverse in factor.blocks:
            before[:] = K[rows, : rows.start]
            inverse[:] = np.tril(dtrtri(K[rows, rows], lower=1)[0])
        return factor

    def __len__(self) -> int:
        return self.size

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.values.nbytes

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of rows from the first to the last, which share the memory of ``values``."""
        found, at = [], 0
        for start, stop in edges(self.size):
            end = at + (stop - start) * stop
            both = self.values[at:end].reshape((stop - start, stop), order="F")
            found.append(Block(slice(start, stop), both[:, :start], both[:, start:]))
            at = end
        return tuple(found)

    def solve_rows(self, rows: FloatArray) -> None:
        """Replace ``rows``, shape (m, J) in C order, by ``K^-1 rows``."""
        if not rows.size:
            return
        columns = rows.T  # as BLAS sees it: a slice of its columns needs no copy
        for at, before, inverse in self.blocks:
            own = columns[:, at]
            if at.start:
                known = columns[:, : at.start]
                dgemm(-1.0, known, before, beta=1.0, c=own, trans_b=1, overwrite_c=1)
            dtrmm(1.0, inverse, own, side=1, lower=1, trans_a=1, overwrite_b=1)

    def solve_transposed(self, rows: FloatArray) -> None:
        """Replace ``rows``, shape (m, J) in C order, by ``K^-T rows``."""
        if not rows.size:
            return
        columns = rows.T
        for at, before, inverse in reversed(self.blocks):
            own = columns[:, at]
            dtrmm(1.0, inverse, own, side=1, lower=1, overwrite_b=1)
            if at.start:
                dgemm(-1.0, own, before, beta=1.0, c=columns[:, : at.start], overwrite_c=1)


def edges(size: int) -> list[tuple[int, int]]:
    """Return where the blocks of so many rows start and stop."""
    return [(start, min(start + BLOCK, size)) for start in range(0, size, BLOCK)]


def count(size: int) -> int:
    """Return how many numbers a factor of so many rows takes."""
    return sum((stop - start) * stop for start, stop in edges(size))
