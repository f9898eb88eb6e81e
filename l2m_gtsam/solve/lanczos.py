"""Lanczos' iteration: the largest eigenvalues of a symmetric matrix from products with it."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import eigh_tridiagonal

from l2m_gtsam.data import FloatArray

Product = Callable[[FloatArray], FloatArray]


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
