import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.hyperparameters import (
    KernelHyperparameters,
    KernelLearningOptions,
    Neighbourhood,
    from_log,
    learn,
    log_likelihood,
    neighbourhood,
)
from l2m_gtsam.maps.training import ThinningOptions, TrainingSet

TRUTH = KernelHyperparameters(length_scale=0.6, signal=3.0, noise=0.3)
KEEP_ALL = ThinningOptions(spacing=0)


def covariance(near: Neighbourhood, hyperparameters: KernelHyperparameters) -> FloatArray:
    squared = near.squared_distance / hyperparameters.length_scale**2
    noise = np.diag(hyperparameters.noise**2 / near.weight)
    return np.asarray(hyperparameters.signal**2 * np.exp(-0.5 * squared) + noise)


def drawn(seed: int, count: int = 300) -> TrainingSet:
    """Readings of a field that is a Gaussian process with the hyperparameters ``TRUTH``."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, [4, 3, 0.6], (count, 3))
    weight = rng.integers(1, 5, count).astype(np.float64)
    blank = neighbourhood(TrainingSet(points, np.zeros((count, 3)), weight), np.zeros(3))
    L = np.linalg.cholesky(covariance(blank, TRUTH))
    return TrainingSet(points, [20, 5, -40] + L @ rng.normal(size=(count, 3)), weight)


def test_the_value_is_the_density_of_a_multivariate_normal() -> None:
    near = neighbourhood(drawn(0, 40), np.array([20.0, 5.0, -40.0]))
    normal = multivariate_normal(np.zeros(40), covariance(near, TRUTH))
    expected = sum(normal.logpdf(axis) for axis in near.residual.T)
    # Both sum about 120 terms of order one.
    assert log_likelihood(near, TRUTH).value == pytest.approx(expected, rel=1e-10)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    length_scale=st.floats(0.2, 3),
    signal=st.floats(0.5, 10),
    noise=st.floats(0.1, 1),
)
def test_the_gradient_is_the_derivative_of_the_value(
    seed: int, length_scale: float, signal: float, noise: float
) -> None:
    near = neighbourhood(drawn(seed, 30), np.array([20.0, 5.0, -40.0]))
    x = np.log([length_scale, signal, noise])
    end = log_likelihood(near, from_log(x))
    step = 1e-5
    for j, axis in enumerate(np.eye(3)):
        up, down = (log_likelihood(near, from_log(x + sign * step * axis)) for sign in (1, -1))
        slope = (up.value - down.value) / (2 * step)
        # Rounding of the value, at worst 1e-11 of it through the condition of K, over the step.
        tolerance = 1e-6 * (abs(end.value) + abs(end.gradient[j]))
        assert end.gradient[j] == pytest.approx(slope, abs=tolerance)


def fisher_information(near: Neighbourhood, hyperparameters: KernelHyperparameters) -> FloatArray:
    """Expected curvature of the likelihood of three axes in the logarithms, shape (3, 3)."""
    x = np.log([hyperparameters.length_scale, hyperparameters.signal, hyperparameters.noise])
    step = 1e-5
    slopes = [
        (covariance(near, from_log(x + step * a)) - covariance(near, from_log(x - step * a)))
        / (2 * step)
        for a in np.eye(3)
    ]
    parts = [np.linalg.solve(covariance(near, hyperparameters), slope) for slope in slopes]
    return np.array([[1.5 * np.sum(a * b.T) for a in parts] for b in parts])


def test_known_hyperparameters_are_recovered_within_their_sampling_error() -> None:
    options = KernelLearningOptions(readings=400)
    scores = []
    for seed in range(8):
        readings = drawn(seed)
        fit = learn(readings, options, KEEP_ALL)
        assert fit.converged
        assert fit.readings == len(readings)
        near = neighbourhood(readings, readings.mean)
        sigma = np.sqrt(np.diag(np.linalg.inv(fisher_information(near, TRUTH))))
        found, true = fit.hyperparameters, TRUTH
        error = np.log(
            [
                found.length_scale / true.length_scale,
                found.signal / true.signal,
                found.noise / true.noise,
            ]
        )
        scores.append(error / sigma)
    # Of 24 standard normal scores the largest is below 4 in 998 of 1,000 draws, and the mean
    # square is between 0.3 and 2.2 in 99.9 % even if the three of a draw were fully correlated.
    assert np.abs(scores).max() < 4
    assert 0.3 < np.mean(np.square(scores)) < 2.2


def test_neighbourhoods_of_a_large_set_agree_with_the_truth() -> None:
    readings = drawn(3, 1500)
    fit = learn(readings, KernelLearningOptions(neighbourhoods=6, readings=200), KEEP_ALL)
    assert fit.converged
    assert fit.readings == 1200
    # 200 readings determine each to some 5-10 %, six overlapping draws to half of that.
    assert fit.hyperparameters.length_scale == pytest.approx(TRUTH.length_scale, rel=0.15)
    assert fit.hyperparameters.signal == pytest.approx(TRUTH.signal, rel=0.25)
    assert fit.hyperparameters.noise == pytest.approx(TRUTH.noise, rel=0.15)


def test_learning_is_reproducible() -> None:
    readings = drawn(5, 600)
    options = KernelLearningOptions(neighbourhoods=2, readings=100, seed=11)
    assert learn(readings, options, KEEP_ALL) == learn(readings, options, KEEP_ALL)


def test_learning_ends_higher_than_it_started() -> None:
    readings = drawn(6, 200)
    fit = learn(readings, KernelLearningOptions(), KEEP_ALL)
    near = neighbourhood(readings, readings.mean)
    assert fit.log_likelihood > log_likelihood(near, fit.start).value
    assert fit.log_likelihood > log_likelihood(near, TRUTH).value


def test_a_hyperparameter_that_ends_on_a_bound_is_named() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform(0, [4, 3, 0.6], (150, 3))
    exact = TrainingSet(points, np.sin(points[:, ::-1] / 2), np.ones(150))
    fit = learn(exact, KernelLearningOptions(), KEEP_ALL)
    assert "noise" in fit.at_bound
    assert not fit.converged


def test_pure_noise_is_learnt_as_noise() -> None:
    rng = np.random.default_rng(9)
    points = rng.uniform(0, 2, (500, 3))
    fit = learn(
        TrainingSet(points, rng.normal(0, 1, (500, 3)), np.ones(500)),
        KernelLearningOptions(),
        ThinningOptions(),
    )
    found = fit.hyperparameters
    # Two neighbourhoods of 900 numbers each: 2 % of their standard deviation, in two parts where
    # the length scale falls below the distance of readings.
    assert np.hypot(found.signal, found.noise) == pytest.approx(1, rel=0.1)


def test_readings_that_do_not_vary_are_refused() -> None:
    points = np.random.default_rng(8).uniform(0, 3, (50, 3))
    still = TrainingSet(points, np.tile([20.0, 0.0, -40.0], (50, 1)), np.ones(50))
    with pytest.raises(MapError, match="all map training readings are equal"):
        learn(still, KernelLearningOptions(), KEEP_ALL)


def test_a_covariance_that_cannot_be_factorised_is_an_error_that_says_so() -> None:
    twice = TrainingSet(np.zeros((20, 3)), np.zeros((20, 3)), np.ones(20))
    silent = KernelHyperparameters(length_scale=1, signal=1, noise=1e-9)
    with pytest.raises(MapError, match=r"not positive definite at noise 1e-09 uT .* larger noise"):
        log_likelihood(neighbourhood(twice, np.zeros(3)), silent)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["length_scale", "signal", "noise"])
def test_hyperparameters_are_positive_and_finite(name: str, value: float) -> None:
    values = {"length_scale": 1.0, "signal": 1.0, "noise": 1.0, name: value}
    with pytest.raises(ValidationError, match=name):
        KernelHyperparameters(**values)
