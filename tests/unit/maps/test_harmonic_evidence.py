"""Evidence and posterior of weights, against the dense process; sums over readings."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.evidence import (
    Evidence,
    Normal,
    condition,
    evidence,
    marginalised,
    normal_of,
)
from l2m_gtsam.maps.training import TrainingSet, training_set
from tests.worlds.harmonic import FAMILIES, GIVEN, TILTED, basis, places


def survey(count: int = 60, seed: int = 3) -> TrainingSet:
    """Readings drawn from the prior of ``basis``, of different weights."""
    rng = np.random.default_rng(seed)
    model = basis()
    points = places(count, seed) @ TILTED.T + model.frame.corner
    weight = rng.uniform(0.5, 4.0, count)
    w = np.exp(0.5 * model.prior(GIVEN).log_variance) * rng.normal(size=len(model))
    noise = GIVEN.noise * rng.normal(size=(count, 3)) / np.sqrt(weight)[:, None]
    return training_set(points, model.features(points) @ w + noise, weight)


def dense_covariance(readings: TrainingSet, log_variance: FloatArray, noise: float) -> FloatArray:
    """Covariance of all readings, shape (3 N, 3 N)."""
    F = basis().features(readings.points).reshape(-1, len(basis()))
    own = np.repeat(noise**2 / readings.weight, 3)
    return np.asarray((F * np.exp(log_variance)) @ F.T + np.diag(own))


def evidence_at(log_variance: FloatArray, log_noise: float) -> Evidence:
    return evidence(normal_of(basis(), survey()), log_variance, float(np.exp(log_noise)))


def test_the_evidence_is_the_gaussian_density_of_the_readings() -> None:
    readings, log_variance = survey(), basis().prior(GIVEN).log_variance
    for noise in (0.05, GIVEN.noise, 1.0):
        dense = dense_covariance(readings, log_variance, noise)
        expected = multivariate_normal.logpdf(readings.field.ravel(), cov=dense)
        # Condition 1e8 (100 uT against 0.05) of sums that are of order 1e3.
        assert evidence_at(log_variance, np.log(noise)).value == pytest.approx(expected, rel=1e-7)


def test_slopes_of_the_evidence_are_its_derivatives() -> None:
    log_variance, log_noise = basis().prior(GIVEN).log_variance, float(np.log(GIVEN.noise))
    ours = evidence_at(log_variance, log_noise)
    # The field's square over the noise's, 5e7, ends in digits of 1e-8: 1e-5 of a slope. Third
    # derivatives of a few units times the step's square are less.
    step, tolerance = 1e-3, 1e-4
    for column, unit in enumerate(np.eye(len(log_variance))):
        up, down = (evidence_at(log_variance + s * unit, log_noise).value for s in (step, -step))
        slope = (up - down) / (2 * step)
        assert ours.slopes().by_log_variance[column] == pytest.approx(slope, abs=tolerance)
    up, down = (evidence_at(log_variance, log_noise + s).value for s in (step, -step))
    assert ours.slopes().by_log_noise == pytest.approx((up - down) / (2 * step), rel=tolerance)


def test_the_posterior_is_that_of_the_dense_process() -> None:
    readings, model = survey(), basis()
    log_variance = model.prior(GIVEN).log_variance
    ours = condition(normal_of(model, readings), log_variance, GIVEN.noise)
    at = places(15, seed=8) @ TILTED.T + model.frame.corner
    F_at = model.features(at).reshape(-1, len(model))
    F = model.features(readings.points).reshape(-1, len(model))
    cross = (F_at * np.exp(log_variance)) @ F.T
    solved = np.linalg.solve(dense_covariance(readings, log_variance, GIVEN.noise), cross.T)
    mean, covariance = solved.T @ readings.field.ravel(), -cross @ solved
    covariance += (F_at * np.exp(log_variance)) @ F_at.T
    L = ours.unwhitened(np.eye(len(ours.mean)))
    # Condition 1e6 (100 uT against 0.1) of numbers up to 100 (mean) and 1e4 (prior covariance).
    np.testing.assert_allclose(F_at @ ours.mean, mean, rtol=0, atol=1e-8)
    np.testing.assert_allclose(F_at @ L @ L.T @ F_at.T, covariance, rtol=0, atol=1e-7)


def test_information_is_that_of_the_dense_process() -> None:
    """Half the trace of S^-1 dS_a S^-1 dS_b, the expected curvature of a normal density."""
    readings, prior = survey(), basis().prior(GIVEN)
    by = np.stack(list(prior.slopes.values()))
    ours = evidence_at(prior.log_variance, float(np.log(GIVEN.noise))).slopes().information(by)
    F = basis().features(readings.points).reshape(-1, len(basis()))
    dense = dense_covariance(readings, prior.log_variance, GIVEN.noise)
    change = [
        np.linalg.solve(dense, (F * np.exp(prior.log_variance) * slope) @ F.T) for slope in by
    ]
    expected = [[0.5 * np.trace(a @ b) for b in change] for a in change]
    # Condition 1e6 of numbers of order ten.
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-6)


def test_weights_that_are_integrated_out_leave_the_same_slopes() -> None:
    readings, model = survey(), basis()
    normal, log_variance = normal_of(model, readings), model.prior(GIVEN).log_variance
    kept = np.arange(len(model) - 4, len(model))
    alone = marginalised(normal, kept, log_variance, GIVEN.noise)
    steps = np.array([-2.0, 0.0, 1.0])
    values = []
    for step in steps:
        moved = log_variance.copy()
        moved[kept] += step
        whole = evidence(normal, moved, GIVEN.noise)
        part = evidence(alone, moved[kept], GIVEN.noise)
        # Condition 1e6 of slopes of order one.
        np.testing.assert_allclose(
            part.slopes().by_log_variance,
            whole.slopes().by_log_variance[kept],
            rtol=0,
            atol=1e-6,
        )
        values.append(whole.value - part.value)
    np.testing.assert_allclose(values, values[0], rtol=0, atol=1e-5)


def assert_same_sums(one: Normal, other: Normal) -> None:
    # Sums of the same numbers in another order, differences of them at worst.
    np.testing.assert_allclose(one.FF, other.FF, rtol=0, atol=1e-12 * np.abs(other.FF).max())
    np.testing.assert_allclose(one.Fy, other.Fy, rtol=0, atol=1e-11 * np.abs(other.Fy).max())
    assert one.yy == pytest.approx(other.yy, rel=1e-11)
    assert one.rows == other.rows
    assert one.log_weight == pytest.approx(other.log_weight, abs=1e-11)


@settings(max_examples=10)
@given(cut=st.integers(1, 59), seed=st.integers(0, 100))
def test_sums_over_readings_add_and_subtract(cut: int, seed: int) -> None:
    rows = np.random.default_rng(seed).permutation(60)
    model, readings = basis(), survey()
    first, second = (normal_of(model, readings[part]) for part in (rows[:cut], rows[cut:]))
    assert_same_sums(first + second, normal_of(model, readings))
    assert_same_sums((first + second) - first, second)


def test_a_reading_of_weight_two_is_two_readings() -> None:
    readings, model = survey(), basis()
    twice = training_set(
        np.repeat(readings.points, 2, axis=0), np.repeat(readings.field, 2, axis=0)
    )
    once = training_set(readings.points, readings.field, np.full(60, 2.0))
    one, other = normal_of(model, once), normal_of(model, twice)
    np.testing.assert_allclose(one.FF, other.FF, rtol=0, atol=1e-12 * np.abs(one.FF).max())
    np.testing.assert_allclose(one.Fy, other.Fy, rtol=0, atol=1e-12 * np.abs(one.Fy).max())


def test_weights_known_far_better_than_the_prior_are_no_trouble() -> None:
    """Whitened information of 1e17: the factor must exist and the mean must fit the readings."""
    readings, model = survey(), basis()
    wide = np.full(len(model), np.log(1e16))
    ours = condition(normal_of(model, readings), wide, 1e-3)
    fit = model.features(readings.points) @ ours.mean
    assert np.isfinite(fit).all()
    # Ordinary least squares of noise 0.2 on weight one or so.
    assert np.sqrt(np.mean((fit - readings.field) ** 2)) < 0.3


def test_a_damped_weight_keeps_its_prior() -> None:
    """Without readings nearby the posterior of a weight is its prior."""
    readings, model = survey(), basis()
    far = replace(readings, points=readings.points + 1e3 * TILTED[:, 2])
    floor = slice(3, 3 + len(FAMILIES["floor"]))
    silent = Basis(model.frame, (model.families[0], model.families[1]))
    assume_prior = silent.prior(GIVEN).log_variance
    ours = condition(normal_of(silent, far), assume_prior, GIVEN.noise)
    L = ours.unwhitened(np.eye(len(ours.mean)))
    np.testing.assert_allclose(
        np.diag(L @ L.T)[floor], np.exp(assume_prior)[floor], rtol=1e-9
    )  # exp(-1000 k) of a mode is left there
