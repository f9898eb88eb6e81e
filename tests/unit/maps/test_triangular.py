"""Solves with a factor whose diagonal blocks are inverted, against LAPACK's own."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.triangular import BLOCK, TriangularFactor, count


def matrix(size: int) -> FloatArray:
    """Return the factor of a covariance of condition about 1e4, with a full upper triangle."""
    rng = np.random.default_rng(size)
    A = rng.normal(size=(size, size))
    above = np.triu(np.full((size, size), 7.0), 1)  # that nothing may look at
    return np.asarray(np.linalg.cholesky(A @ A.T + 0.01 * size * np.eye(size)) + above)


@pytest.mark.parametrize("size", [1, 2, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5])
@pytest.mark.parametrize("width", [0, 1, 40])
def test_solves_are_those_of_lapack(size: int, width: int) -> None:
    K, right = matrix(size), np.random.default_rng(0).normal(size=(size, width))
    factor = TriangularFactor.of(K)
    ours, transposed = right.copy(), right.copy()
    factor.solve_rows(ours)
    factor.solve_transposed(transposed)
    # Rounding times the condition of the factor, some hundreds.
    close = {"rtol": 0, "atol": 1e-11 * np.abs(np.linalg.inv(np.tril(K))).sum(axis=1).max()}
    np.testing.assert_allclose(ours, solve_triangular(K, right, lower=True), **close)
    np.testing.assert_allclose(transposed, solve_triangular(K, right, lower=True, trans=1), **close)


def test_its_numbers_are_all_there_is_of_it() -> None:
    factor = TriangularFactor.of(matrix(2 * BLOCK + 7))
    assert factor.values.shape == (count(len(factor)),)
    again, right = TriangularFactor(len(factor), factor.values.copy()), np.eye(len(factor))
    expected = right.copy()
    factor.solve_rows(expected)
    again.solve_rows(right)
    np.testing.assert_array_equal(right, expected)
