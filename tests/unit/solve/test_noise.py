"""Noise of readings: covariance, whitening and the estimate of a sensor's own part."""

import numpy as np
import pytest

from l2m_gtsam.solve.noise import (
    estimate_noise,
    map_covariance,
    reading_covariance,
    residual_figures,
    whitening,
)


def test_whitening_makes_unit_covariance() -> None:
    rng = np.random.default_rng(0)
    C = np.eye(3) + rng.normal(0, 0.2, (50, 3, 3))
    R = np.linalg.qr(rng.normal(size=(50, 3, 3)))[0]
    variance = rng.uniform(0.01, 1, (50, 3))
    S = reading_covariance(rng.uniform(0.1, 0.3, 50), map_covariance(C, R, variance))
    W = whitening(S)
    np.testing.assert_allclose(
        W @ S @ W.transpose(0, 2, 1), np.broadcast_to(np.eye(3), S.shape), atol=1e-12
    )


def test_whitening_is_the_inverse_of_the_cholesky_factor() -> None:
    root = np.random.default_rng(4).normal(size=(50, 3, 3))
    S = root @ root.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    # Of condition 1e4 at most.
    expected = np.tril(np.linalg.inv(np.linalg.cholesky(S)))
    np.testing.assert_allclose(whitening(S), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_covariance_that_is_none_is_refused(axis: int) -> None:
    S = np.tile(np.eye(3), (5, 1, 1))
    S[3, axis, axis] = -1.0
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        whitening(S)


def test_map_share_is_what_sampling_shows() -> None:
    """Covariance of C R^T d over 200,000 draws of the map's error; sampling error below 1 %."""
    rng = np.random.default_rng(1)
    C = np.eye(3) + rng.normal(0, 0.2, (3, 3))
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    variance = np.array([0.2, 1.0, 3.0])
    draws = rng.normal(size=(200_000, 3)) * np.sqrt(variance) @ R @ C.T
    share = map_covariance(C[None], R[None], variance[None])[0]
    np.testing.assert_allclose(np.cov(draws.T), share, atol=0.03)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 2.0])
def test_sensor_noise_is_separated_from_the_maps(sigma: float) -> None:
    """30,000 numbers give sigma to 0.4 % where the map adds little, worse where it dominates."""
    rng = np.random.default_rng(2)
    v = rng.uniform(0, 0.04, 10_000)
    residual = rng.normal(size=(10_000, 3)) * np.sqrt(sigma**2 + v)[:, None]
    assert estimate_noise(residual, v, 1.0) == pytest.approx(sigma, rel=0.06)


def test_what_a_fit_took_is_not_taken_for_quiet() -> None:
    """30 values, 12 of them fitted: without them sigma comes out a quarter too small.

    The mean square of 2,000 draws has a standard error of 0.8 %.
    """
    rng = np.random.default_rng(3)
    A = rng.normal(size=(30, 12))
    outside = np.eye(30) - A @ np.linalg.pinv(A)
    squares = [
        estimate_noise((outside @ rng.normal(0, 0.2, 30)).reshape(10, 3), np.zeros(10), 0.6) ** 2
        for _ in range(2000)
    ]
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.2, rel=0.02)


def test_readings_that_a_fit_follows_more_closely_count_by_what_is_left_of_them() -> None:
    """Half of the readings are quiet and followed closely: with the mean share of all, sigma comes
    out 5 % too small. 2,000 draws of 120 numbers have a standard error of 0.2 %."""
    rng, count = np.random.default_rng(5), 40
    v = np.repeat([0.0, 0.16], count // 2)
    total = np.repeat(0.04 + v, 3)
    A = rng.normal(size=(3 * count, 12)) * np.repeat(np.repeat([1.0, 0.1], count // 2), 3)[:, None]
    fitted = A @ np.linalg.solve(A.T @ (A / total[:, None]), A.T)
    left = 1 - np.diag(fitted).reshape(-1, 3).sum(axis=1) / total.reshape(-1, 3).sum(axis=1)
    outside = np.eye(3 * count) - fitted / total
    each, even = [], []
    for _ in range(2000):
        residual = (outside @ (np.sqrt(total) * rng.standard_normal(3 * count))).reshape(-1, 3)
        each.append(estimate_noise(residual, v, left) ** 2)
        even.append(estimate_noise(residual, v, 1 - 12 / (3 * count)) ** 2)
    assert np.sqrt(np.mean(each)) == pytest.approx(0.2, rel=0.01)
    assert np.sqrt(np.mean(even)) < 0.193


def test_noise_of_residuals_below_the_maps_own_is_the_floor() -> None:
    assert estimate_noise(np.zeros((10, 3)), np.ones(10), 1.0) == pytest.approx(1e-4)


def test_figures_of_known_residuals() -> None:
    residual = np.array([[3.0, 0, 0], [0, 4.0, 0], [0, 0, 12.0]])
    figures = residual_figures(residual, residual / 2, taken=5)
    assert figures.rms == pytest.approx(np.sqrt(169 / 3))
    assert figures.median_norm == 4.0
    assert figures.max_norm == 12.0
    assert figures.chi2_per_dof == pytest.approx(169 / 4 / 4)
    np.testing.assert_allclose(figures.rms_axes, np.array([3, 4, 12]) / np.sqrt(3))
