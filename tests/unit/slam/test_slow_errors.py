"""Slow errors of readings as variables: the chain and the bridges have the process's covariance."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_factors import N, SlowError, slow_bridge, slow_error_graph
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise, SlowErrors, whiten

TIMES = np.array([0.0, 0.4, 1.0, 1.1, 3.0])


def test_the_chain_has_the_process_covariance() -> None:
    tau = 0.8
    values = gtsam.Values()
    for k in range(len(TIMES)):
        values.insert(N(k), np.zeros(3))
    marginals = gtsam.Marginals(slow_error_graph(TIMES, tau), values)
    keys = [N(k) for k in range(len(TIMES))]
    joint = marginals.jointMarginalCovariance(keys).fullMatrix()
    expected = np.exp(-np.abs(np.subtract.outer(TIMES, TIMES)) / tau)
    np.testing.assert_allclose(joint, np.kron(expected, np.eye(3)), atol=1e-9)


def test_errors_cost_what_the_process_has_them_cost() -> None:
    """Half of n^T K^-1 n along each axis, wherever the graph is linearised."""
    tau, rng, values = 0.8, np.random.default_rng(2), gtsam.Values()
    n = rng.normal(size=(len(TIMES), 3))
    for k, own in enumerate(n):
        values.insert(N(k), own)
    graph = slow_error_graph(TIMES, tau)
    K = np.exp(-np.abs(np.subtract.outer(TIMES, TIMES)) / tau)
    cost = 0.5 * float(np.sum(n * np.linalg.solve(K, n)))
    assert graph.error(values) == pytest.approx(cost, rel=1e-9)
    best = values.retract(graph.linearize(values).optimize())
    for k in range(len(TIMES)):
        np.testing.assert_allclose(best.atVector(N(k)), 0.0, atol=1e-9)


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=6),
    st.floats(1e-3, 1e3),
    st.floats(1e-2, 1e2),
)
def test_a_bridge_is_the_process_given_its_ends(
    shares: list[float], whole_s: float, tau_s: float
) -> None:
    """Against the conditional distribution of a joint normal one, by its definition."""
    t = whole_s * np.array(shares)
    every = np.concatenate([[0.0, whole_s], t])
    K = np.exp(-np.abs(np.subtract.outer(every, every)) / tau_s)
    mean = np.linalg.solve(K[:2, :2], K[:2, 2:]).T
    found = slow_bridge(t, whole_s - t, tau_s)
    # Ends that are nearly the same leave few digits of the definition: 1e-16 / 1e-5.
    np.testing.assert_allclose(found.shares, mean, atol=1e-8)
    np.testing.assert_allclose(found.covariance, K[2:, 2:] - mean @ K[:2, 2:], atol=1e-8)


def test_what_readings_have_of_it_has_its_variance() -> None:
    """Means of both ends and what remains together: s^2 at each reading, as it was told."""
    noise = SensorNoise(2.0, 0.25, 1.5)
    stamps = (1e9 * TIMES).astype(np.int64)
    at = np.array([1.2, 2.0, 2.9])
    error, left = SlowErrors(noise, stamps, (1e9 * at).astype(np.int64)).of(3, np.arange(3))
    ends = np.exp(-np.abs(np.subtract.outer(TIMES[3:], TIMES[3:])) / noise.slow_s)
    covariance = error.shares @ ends @ error.shares.T
    covariance += np.einsum("nim,kim->nk", left, left) / 3
    expected = noise.slow_ut**2 * np.exp(-np.abs(np.subtract.outer(at, at)) / noise.slow_s)
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


@given(
    white=st.floats(1e-3, 1 - 1e-3),
    slow_s=st.floats(0.05, 50.0),
    apart=st.lists(st.floats(0.0, 10.0), min_size=1, max_size=12),
)
def test_rows_are_made_white_as_by_the_cholesky_factor(
    white: float, slow_s: float, apart: list[float]
) -> None:
    """Readings at one time, too: their white noise is their own."""
    noise, seconds = SensorNoise(0.7, white, slow_s), np.cumsum(apart)
    alike = np.exp(-np.abs(np.subtract.outer(seconds, seconds)) / slow_s)
    covariance = noise.slow_ut**2 * alike + noise.white_ut**2 * np.eye(len(seconds))
    lower = np.linalg.cholesky(covariance)
    rows = np.random.default_rng(0).normal(size=(len(seconds), 4))
    expected = np.linalg.solve(lower, rows)
    volume = whiten(noise, seconds, rows)
    # The covariance is at worst 1e4 times worse conditioned than its white part.
    np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-9)
    assert volume == pytest.approx(np.log(np.diag(lower)).sum(), rel=1e-9, abs=1e-9)
