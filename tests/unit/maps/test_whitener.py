"""Posterior variances of a block, against the formula written out."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.maps.posterior import STRIPE, Whitener, kernel_matrix

SIGNAL, NOISE = 8.0, 0.3  # uT

sizes = st.sampled_from([1, 2, STRIPE - 1, STRIPE, STRIPE + 1, 2 * STRIPE, 3 * STRIPE + 5])


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), count=sizes, asked=st.integers(1, 40))
def test_variances_are_the_formula(seed: int, count: int, asked: int) -> None:
    rng = np.random.default_rng(seed)
    y, x = rng.normal(0, 2, (count, 3)), rng.normal(0, 3, (asked, 3))
    K = kernel_matrix(y, y, SIGNAL) + NOISE**2 * np.eye(count)
    whitener = Whitener.of(np.asfortranarray(np.linalg.cholesky(K)))
    variance, nearest = whitener.variance(x, y, SIGNAL, np.full(count * asked, np.nan))
    k = kernel_matrix(y, x, SIGNAL)
    expected = SIGNAL**2 - np.einsum("mn,mn->n", k, np.linalg.solve(K, k))
    # The condition of K is below M s^2 / noise^2, 1.4e5; ten times its rounding, of s^2.
    np.testing.assert_allclose(variance, expected, rtol=0, atol=3e-10 * SIGNAL**2)
    away = ((x[:, None] - y) ** 2).sum(axis=2).min(axis=1)
    np.testing.assert_allclose(nearest, away, rtol=1e-14)


def test_far_from_readings_the_prior_is_left() -> None:
    y = np.random.default_rng(0).normal(size=(70, 3))
    K = kernel_matrix(y, y, SIGNAL) + NOISE**2 * np.eye(70)
    whitener = Whitener.of(np.asfortranarray(np.linalg.cholesky(K)))
    variance, nearest = whitener.variance(np.array([[1e6, 0, 0]]), y, SIGNAL, np.empty(70))
    assert variance[0] == SIGNAL**2
    assert nearest[0] > 1e3


def test_stripes_take_little_more_than_half() -> None:
    whitener = Whitener.of(np.asfortranarray(np.eye(10 * STRIPE)))
    assert len(whitener.entries) * 100 == 55 * (10 * STRIPE) ** 2
