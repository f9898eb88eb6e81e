"""Linear algebra: roots and inverses of covariances, parts of large matrices, Lanczos' iteration.

Covariances may be badly scaled or singular. Tall matrices are of many rows that know little of each
other, in products as fast as dense ones.

Readings of one place follow the same few hundred of thousands of variables: of some rows in order
most columns are zero, and nearly all others full. Sparse products of such a matrix take up to
thirty times as long as those of its full blocks, and as a whole it would not fit into memory.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import cholesky, eigh_tridiagonal
from scipy.linalg.lapack import dgeqrf, dpotri, dpstrf, dtrtri
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from l2m_gtsam.data import FloatArray, IntArray

EXACT = 1e-12  # of the largest variance, in units of sigmas: a direction without an error
LEFT_OUT = 1e-6  # of the least eigenvalue that is looked for
ROWS = 192  # of a block: enough for a fast product, few enough to be of one place
Product = Callable[[FloatArray], FloatArray]


def covariance_root(covariance: FloatArray, sigma: FloatArray | float = 1.0) -> FloatArray:
    """Return G with ``G G^T`` the covariance, both of shape (n, n); it may be singular.

    A Cholesky factor does not exist there; eigenvalues below zero by rounding count as zero.

    Parameters
    ----------
    covariance
        Symmetric matrix, shape (n, n), in squared units.
    sigma
        Scale of each component, shape (n,), by which rows and columns are divided before the
        decomposition: rad beside uT would lose the smaller ones' digits. Where it is 0, as the
        standard deviation of what is exact, it counts as 1.
    """
    scale = np.broadcast_to(sigma, len(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def information_root(covariance: FloatArray, sigma: FloatArray, least: float) -> FloatArray:
    """Return W with ``W S W^T = I``, where a nearly singular S is kept invertible.

    Parameters
    ----------
    covariance
        S, shape (n, n).
    sigma
        Scale of each component, above zero, shape (n,).
    least
        Smallest eigenvalue of the scaled covariance; smaller ones are raised to it.
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray((vectors / np.sqrt(np.maximum(values, least))).T / sigma)


def sound_information_root(covariance: FloatArray) -> FloatArray:
    """Return W with ``W^T W`` the pseudo-inverse of a covariance, shape (r, n).

    A row for each direction that is no more exact, in units of sigmas, than rounding lets it be.
    """
    sigma = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    sound = values > EXACT * values[-1]
    return np.asarray((vectors[:, sound] / np.sqrt(values[sound])).T / sigma)


def triangular_information_root(covariance: FloatArray, ridge: float) -> FloatArray:
    """Return the lower triangle W with ``W^T W`` the inverse of a covariance.

    Of an information it gives the covariance.

    Parameters
    ----------
    covariance
        Positive definite but for rounding, shape (n, n).
    ridge
        Added to each variance as a share of it.

    Raises
    ------
    LinAlgError
        The covariance is not positive definite.
    """
    sigma = np.sqrt(np.diag(covariance))
    lower = correlation_factor(covariance, ridge)
    W, _ = dtrtri(lower, lower=1)
    return np.asarray(W / sigma)


def correlation_factor(covariance: FloatArray, ridge: float) -> FloatArray:
    """Return the lower Cholesky factor of a covariance's correlations; as above."""
    sigma = np.sqrt(np.diag(covariance))
    # Metres beside microtesla: scaled to correlations before factorising.
    correlation = covariance / np.outer(sigma, sigma) + ridge * np.eye(len(sigma))
    return np.asarray(cholesky(correlation, lower=True, check_finite=False))


def lower_information_root(covariance: FloatArray) -> FloatArray:
    """Return the lower triangle W with ``W S W^T = I``, both of shape (n, n).

    Of a covariance that is well scaled and positive definite; row by row, each is what a component
    says beyond those before it.

    Raises
    ------
    LinAlgError
        The covariance is not positive definite.
    """
    # S = K K^T, hence W = K^-1.
    W, _ = dtrtri(np.linalg.cholesky(covariance), lower=1)
    return np.ascontiguousarray(W)


def triangular_rows(rows: FloatArray) -> FloatArray:
    """Return R of ``rows = Q R`` with orthonormal Q, shapes (m, n) and (least of m and n, n).

    NumPy's takes twice as long for thousands of rows of a few columns.
    """
    packed, *_ = dgeqrf(rows)
    return np.triu(packed[: rows.shape[1]])


def right_divided(A: FloatArray, C: FloatArray) -> FloatArray:
    """Return ``A C^-1``, the solution X of ``X C = A``; shapes (..., m, n) and (..., n, n)."""
    shape = np.broadcast_shapes(A.shape[:-2], C.shape[:-2])
    A_T = np.broadcast_to(A.swapaxes(-1, -2), (*shape, *A.shape[:-3:-1]))
    return np.asarray(np.linalg.solve(C.swapaxes(-1, -2), A_T).swapaxes(-1, -2))


def inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices, shape (..., n, n)."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def leading_eigenvectors(matrix: FloatArray, least: float) -> FloatArray:
    """Return the eigenvectors of the largest eigenvalues, those last, shape (n, r).

    Where few are large, a Cholesky factor with pivots has few columns (Harbrecht, Peters and
    Schneider 2012), whose singular vectors they are: of 264 eigenvectors, 13 of which are wanted,
    in a third of the time that all take, the space that they span the same to 1e-7.

    Parameters
    ----------
    matrix
        Symmetric, without negative eigenvalues but for rounding, shape (n, n).
    least
        Of the largest eigenvalue: the share that others must have.
    """
    # What is left once a pivot is that small has no larger diagonal element.
    left = LEFT_OUT * least * float(matrix.diagonal().max(initial=0.0))
    factor, order, rank, _ = dpstrf(matrix, lower=1, tol=left)
    if not rank:  # no eigenvalue is larger than another
        return np.eye(len(matrix))
    root = np.empty((len(matrix), rank))
    root[order - 1] = np.tril(factor[:, :rank])
    vectors, sizes, _ = np.linalg.svd(root, full_matrices=False)
    return np.asfortranarray(vectors[:, sizes**2 >= least * sizes[0] ** 2][:, ::-1])


# NumPy's indexing by two lists of places takes 40 ns for an element that is added. Where thousands
# of groups of readings touch dozens to hundreds of variables each, that was a fifth of a
# calibration's last stage.
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


def inverse_of_factor(lower: FloatArray) -> FloatArray:
    """Return the inverse of a matrix from its Cholesky factor, in C order, shape (n, n).

    The factor has zeros above its diagonal. In Fortran order it is overwritten.
    """
    inverse, _ = dpotri(lower, lower=1, overwrite_c=1)  # above the diagonal zeros stay
    whole = inverse.T
    whole += np.triu(whole, 1).T
    return np.asarray(whole)


@njit(cache=True, nogil=True)
def submatrix(matrix: FloatArray, at: IntArray) -> FloatArray:
    """Return the rows and columns ``at`` of a matrix, in their order, shape (k, k)."""
    found = np.empty((len(at), len(at)))
    for i in range(len(at)):
        row = at[i]
        for j in range(len(at)):
            found[i, j] = matrix[row, at[j]]
    return found


def parts_of(pairs: IntArray, count: int) -> IntArray:
    """Return which connected part of a graph each of its nodes is in, from 0, shape (n,).

    Parameters
    ----------
    pairs
        Nodes that are connected, shape (E, 2).
    count
        Number n of nodes.
    """
    edges = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(edges, directed=False)[1])


def eigenpairs(product: Product, first: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (q,) and eigenvectors (n, q) of a symmetric matrix on a Krylov space.

    Every vector is kept orthogonal to all before (G. Golub, C. Van Loan, "Matrix computations",
    2013, 10.3). The outermost eigenvalues are found first.

    Parameters
    ----------
    product
        Of the matrix with a vector.
    first
        Vector that the space begins with, shape (n,).
    count
        Dimension of the space, n at most.
    """
    basis = np.zeros((count, len(first)))
    diagonal, beside = np.zeros(count), np.zeros(count)
    vector = first / np.linalg.norm(first)
    for j in range(count):
        basis[j] = vector
        vector = product(vector)
        diagonal[j] = vector @ basis[j]
        scale = np.linalg.norm(vector)
        for _ in range(2):  # twice is enough for rounding
            vector = vector - basis[: j + 1].T @ (basis[: j + 1] @ vector)
        beside[j] = np.linalg.norm(vector)
        if beside[j] <= len(first) * np.finfo(np.float64).eps * scale:  # the space is invariant
            count = j + 1
            break
        vector = vector / beside[j]
    values, vectors = eigh_tridiagonal(diagonal[:count], beside[: count - 1])
    return np.asarray(values, dtype=np.float64), np.asarray(basis[:count].T @ vectors)


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
