"""Roots L of what readings of a window have in common: each adds ``L L^T`` to a covariance."""

import numpy as np
from scipy.linalg import solve_triangular

from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.shared import SharedMapErrors
from l2m_gtsam.slam.start.window import Window

ROUNDING = 1e-12  # of a variance in m^2 or uT^2: as good as none


def steps_root(window: Window) -> FloatArray:
    """Return what a unit of each step's errors moves the first frame by, shape (K - 1, 6, 6).

    As seen from what comes after the step.
    """
    back = carried_back(window.R[1:], window.p[1:])
    return np.asarray(np.linalg.solve(back, np.linalg.cholesky(window.covariance)))


def root_of(covariance: FloatArray) -> FloatArray:
    """Return L with ``L L^T`` a covariance that may be singular."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), ROUNDING))
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray(sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def map_root(errors: SharedMapErrors, C: FloatArray) -> FloatArray:
    """Return a root of what the map's errors add to S, shape (3N, K)."""
    columns = []
    for tile, size in errors.sizes.items():
        F = np.zeros((len(C), 3, size))
        own = errors.owner == tile
        F[own] = C[own] @ errors.features[tile]
        columns.append(F.reshape(-1, size))
    W = errors.root_information
    return np.asarray(
        solve_triangular(W, np.concatenate(columns, axis=1).T, lower=True, trans="T").T
    )


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """Return N blocks, shape (N, 3, 3), as one matrix, shape (3N, 3N)."""
    N = len(blocks)
    S = np.zeros((N, 3, N, 3))
    S[np.arange(N), :, np.arange(N)] = blocks
    return S.reshape(3 * N, 3 * N)


def diagonal_blocks(S: FloatArray) -> FloatArray:
    """Return the blocks of three rows on the diagonal, shape (N, 3, 3)."""
    N = len(S) // 3
    return np.asarray(S.reshape(N, 3, N, 3)[np.arange(N), :, np.arange(N)])


def inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices, shape (..., n, n)."""
    return np.asarray(np.linalg.inv(matrices))
