"""Slow errors of readings as variables: the chain and the bridges have the process's covariance."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_factors import N, SlowError, slow_bridge, slow_error_graph
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise, SlowErrors, whiten

PATH = np.array([0.0, 0.4, 1.0, 1.1, 3.0])


def test_the_chain_has_the_process_covariance() -> None:
    tau = 0.8
    values = gtsam.Values()
    for k in range(len(PATH)):
        values.insert(N(k), np.zeros(3))
    marginals = gtsam.Marginals(slow_error_graph(PATH, tau), values)
    keys = [N(k) for k in range(len(PATH))]
    joint = marginals.jointMarginalCovariance(keys).fullMatrix()
    expected = np.exp(-np.abs(np.subtract.outer(PATH, PATH)) / tau)
    np.testing.assert_allclose(joint, np.kron(expected, np.eye(3)), atol=1e-9)


def test_errors_cost_what_the_process_has_them_cost() -> None:
    """Half of n^T K^-1 n along each axis, wherever the graph is linearised."""
    tau, rng, values = 0.8, np.random.default_rng(2), gtsam.Values()
    n = rng.normal(size=(len(PATH), 3))
    for k, own in enumerate(n):
        values.insert(N(k), own)
    graph = slow_error_graph(PATH, tau)
    K = np.exp(-np.abs(np.subtract.outer(PATH, PATH)) / tau)
    cost = 0.5 * float(np.sum(n * np.linalg.solve(K, n)))
    assert graph.error(values) == pytest.approx(cost, rel=1e-9)
    best = values.retract(graph.linearize(values).optimize())
    for k in range(len(PATH)):
        np.testing.assert_allclose(best.atVector(N(k)), 0.0, atol=1e-9)


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=6),
    st.floats(1e-3, 1e3),
    st.floats(1e-2, 1e2),
)
def test_a_bridge_is_the_process_given_its_ends(
    shares: list[float], whole: float, tau: float
) -> None:
    """Against the conditional distribution of a joint normal one, by its definition."""
    t = whole * np.array(shares)
    every = np.concatenate([[0.0, whole], t])
    K = np.exp(-np.abs(np.subtract.outer(every, every)) / tau)
    mean = np.linalg.solve(K[:2, :2], K[:2, 2:]).T
    found = slow_bridge(t, whole - t, tau)
    # Ends that are nearly the same leave few digits of the definition: 1e-16 / 1e-5.
    np.testing.assert_allclose(found.shares, mean, atol=1e-8)
    np.testing.assert_allclose(found.covariance, K[2:, 2:] - mean @ K[:2, 2:], atol=1e-8)


def test_what_readings_have_of_it_has_its_variance() -> None:
    """Means of both ends and what remains together: s^2 at each reading, as it was told."""
    noise = SensorNoise(2.0, 0.25, 1.5)
    at = np.array([1.2, 2.0, 2.9])
    error, left = SlowErrors(noise, PATH, at).of(3, np.arange(3))
    ends = np.exp(-np.abs(np.subtract.outer(PATH[3:], PATH[3:])) / noise.slow_m)
    covariance = error.shares @ ends @ error.shares.T
    covariance += np.einsum("nim,kim->nk", left, left) / 3
    expected = noise.slow_ut**2 * np.exp(-np.abs(np.subtract.outer(at, at)) / noise.slow_m)
    np.testing.assert_allclose(covariance, expected, atol=1e-8)


def test_derivatives_are_those_of_the_residual() -> None:
    """It is linear: a difference is exact but for rounding."""
    error, values = SlowError(2, np.array([[0.3, 0.9], [1.2, 0.1]])), gtsam.Values()
    for key, value in zip(error.keys, np.arange(6.0).reshape(2, 3), strict=True):
        values.insert(key, value)
    for key, block in zip(error.keys, error.jacobians(values), strict=True):
        moved = gtsam.Values(values)
        moved.update(key, values.atVector(key) + np.array([0.0, 1.0, 0.0]))
        change = error.residual(moved) - error.residual(values)
        np.testing.assert_allclose(change, block[:, :, 1], atol=1e-12)


def test_noise_is_split() -> None:
    noise = SensorNoise(2.0, 0.36, 1.0)
    assert noise.white_ut == pytest.approx(1.2)
    assert noise.slow_ut == pytest.approx(1.6)
    assert SensorNoise(1.0, 1e-6, 1.0).floored().white_ut == pytest.approx(0.3)


@pytest.mark.parametrize("slow_m", [0.05, 1.0, 3.0])
def test_white_noise_that_says_as_much_has_the_variance_of_a_mean(slow_m: float) -> None:
    """Of 4,000 readings: what the two ends of them lack is under a percent."""
    noise, count, apart = SensorNoise(0.8, 0.2, slow_m), 4000, 0.12
    path = apart * np.arange(count)
    alike = np.exp(-np.abs(np.subtract.outer(path, path)) / slow_m)
    covariance = noise.slow_ut**2 * alike + noise.white_ut**2 * np.eye(count)
    expected = np.sqrt(covariance.sum() / count)
    assert noise.as_white(apart) == pytest.approx(expected, rel=0.01)


@given(
    white=st.floats(1e-3, 1 - 1e-3),
    slow_m=st.floats(0.05, 50.0),
    apart=st.lists(st.floats(0.0, 10.0), min_size=1, max_size=12),
)
def test_rows_are_made_white_as_by_the_cholesky_factor(
    white: float, slow_m: float, apart: list[float]
) -> None:
    """Readings at one place, too: their white noise is their own."""
    noise, path = SensorNoise(0.7, white, slow_m), np.cumsum(apart)
    alike = np.exp(-np.abs(np.subtract.outer(path, path)) / slow_m)
    covariance = noise.slow_ut**2 * alike + noise.white_ut**2 * np.eye(len(path))
    lower = np.linalg.cholesky(covariance)
    rows = np.random.default_rng(0).normal(size=(len(path), 4))
    expected = np.linalg.solve(lower, rows)
    volume = whiten(noise, path, rows)
    # The covariance is at worst 1e4 times worse conditioned than its white part.
    np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-9)
    assert volume == pytest.approx(np.log(np.diag(lower)).sum(), rel=1e-9, abs=1e-9)
