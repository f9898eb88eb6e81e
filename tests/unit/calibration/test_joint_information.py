"""All variables of the last graph together, against dense algebra."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from l2m_gtsam.calibration.joint_information import HalfCovariance, Rows, leverage
from l2m_gtsam.data import FloatArray


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 30), st.integers(0, 10**6))
def test_half_of_a_covariance_says_what_the_whole_does(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((size, size)) + 3 * np.eye(size)
    information, scale = root @ root.T + np.eye(size), rng.uniform(0.1, 10, size)
    whole = np.linalg.inv(information) * np.outer(scale, scale)
    lower = np.asfortranarray(np.linalg.cholesky(information))
    at = rng.permutation(size)[: size // 2 + 1]
    A = rng.standard_normal((len(at), 3))
    for half in (HalfCovariance.from_factor(lower, scale), HalfCovariance.of(whole)):
        # Rounding, times the condition of a matrix whose diagonal stands out.
        alike = partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-9 * np.abs(whole).max())
        alike(half.among(at), whole[np.ix_(at, at)])
        alike(half.across(at, A), A.T @ whole[np.ix_(at, at)] @ A)
        alike(half.trace(at, A.T), np.trace(A.T @ whole[np.ix_(at, at)] @ A))


@pytest.mark.parametrize("apart", [True, False])
def test_a_fit_takes_of_each_reading_what_dense_algebra_says(apart: bool) -> None:
    """Of readings by themselves, and of such whose errors have something in common."""
    rng, count, weights = np.random.default_rng(4), 5, 4
    rows, at = 3 * count, np.array([5, 1, 3, 0])
    J = rng.standard_normal((rows, weights))
    root = np.tril(rng.standard_normal((rows, rows))) + 4 * np.eye(rows)
    whitening: FloatArray = np.asarray(np.linalg.inv(root))
    if apart:
        readings = np.arange(count)
        whitening = whitening.reshape(count, 3, count, 3)[readings, :, readings]
        root = block_diag(*np.linalg.inv(whitening))
    information = np.eye(6)
    information[np.ix_(at, at)] += J.T @ np.linalg.solve(root @ root.T, J)
    covariance: FloatArray = np.asarray(np.linalg.inv(information))
    white_J: FloatArray = np.asarray(np.linalg.solve(root, J))
    white = Rows(0, at, white_J, np.zeros(rows), np.arange(count))
    fitted = np.diag(J @ covariance[np.ix_(at, at)] @ J.T).reshape(-1, 3).sum(axis=1)
    whole = np.diag(root @ root.T).reshape(-1, 3).sum(axis=1)
    found = leverage(HalfCovariance.of(covariance), white, whitening)
    np.testing.assert_allclose(found, fitted / whole, rtol=1e-9)  # well conditioned
