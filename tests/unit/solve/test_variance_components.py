"""Sizes of processes by their likelihood: closed form, slow reference, statistics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.solve.variance_components import TO_THE_TOP, WeightSystem, shared_components

ROWS, WEIGHTS = 60, 9


def drawn(rng: np.random.Generator, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Z and readings ``Z w + n`` with unit noise."""
    Z = rng.standard_normal((ROWS, len(variances)))
    w = np.sqrt(variances) * rng.standard_normal(len(variances))
    return Z, Z @ w + rng.standard_normal(ROWS)


def system(Z: FloatArray, y: FloatArray) -> WeightSystem:
    return WeightSystem(Z.T @ Z, Z.T @ y)


def dense(Z: FloatArray, y: FloatArray, variances: FloatArray) -> float:
    """Return the logarithm of likelihood beyond that of noise alone, from its definition."""
    unit, zero = np.eye(len(y)), np.zeros(len(y))
    with_them = multivariate_normal(zero, unit + (Z * variances) @ Z.T).logpdf(y)
    return float(with_them - multivariate_normal(zero, unit).logpdf(y))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 2**WEIGHTS - 1))
def test_the_likelihood_is_that_of_the_readings(seed: int, shown: int) -> None:
    rng = np.random.default_rng(seed)
    on = np.array([shown >> k & 1 for k in range(WEIGHTS)])
    variances = on * rng.gamma(1.0, 1.0, WEIGHTS)
    Z, y = drawn(rng, variances)
    found = system(Z, y).fit(variances)
    # Rounding of sums over 60 readings.
    np.testing.assert_allclose(found.likelihood, dense(Z, y, variances), atol=1e-9)
    V = np.eye(ROWS) + (Z * variances) @ Z.T
    np.testing.assert_allclose(found.rest, Z.T @ np.linalg.solve(V, y), atol=1e-9)


def test_what_is_beside_others_is_what_is_left_in_their_presence() -> None:
    rng = np.random.default_rng(1)
    own, others = np.repeat([1.0, 0.0], [4, 5]), np.repeat([0.0, 2.0], [4, 5])
    Z, y = drawn(rng, own + others)
    left = system(Z, y).beside(others)
    gain = left.fit(own).likelihood
    every = system(Z, y)
    expected = every.fit(own + others).likelihood - every.fit(others).likelihood
    np.testing.assert_allclose(gain, expected, atol=1e-9)


def test_sizes_are_where_the_likelihood_is_largest() -> None:
    rng = np.random.default_rng(2)
    spectra = np.repeat(np.eye(2), [4, 5], axis=1)
    Z, y = drawn(rng, np.array([0.5, 3.0]) @ spectra)
    found = system(Z, y).components(spectra)
    best = found.gain / 2
    for factors in ((1.3, 1.0), (0.75, 1.0), (1.0, 1.3), (1.0, 0.75)):
        there = system(Z, y).fit((found.sizes * factors) @ spectra).likelihood
        # The last update gained less than 0.02.
        assert there < best + 0.02


def test_where_a_climb_begins_does_not_matter() -> None:
    """Near the top, or with one process at nothing, from where it has to come back."""
    rng = np.random.default_rng(3)
    spectra = np.repeat(np.eye(2), [4, 5], axis=1)
    Z, y = drawn(rng, np.array([0.5, 3.0]) @ spectra)
    given, squares = ([system(Z, y)], [spectra]), float(y @ y)
    first = shared_components(*given, squares, TO_THE_TOP)
    for near in (first.sizes, np.array([0.0, 2.0])):
        again = shared_components(*given, squares, TO_THE_TOP, near)
        # Three rounds settle the noise to a thousandth, and the gain hangs on it.
        assert again.gain == pytest.approx(first.gain, rel=1e-4)
        np.testing.assert_allclose(again.sizes, first.sizes, rtol=0.02)
        assert again.noise == pytest.approx(first.noise, rel=0.01)


def test_what_is_not_there_has_no_size_in_half_of_all_cases_and_is_rarely_shown() -> None:
    rng = np.random.default_rng(3)
    spectra = np.ones((1, WEIGHTS))
    gains = np.array(
        [system(*drawn(rng, np.zeros(WEIGHTS))).components(spectra).gain for _ in range(400)]
    )
    # A mixture of 0 and chi-square of one: half are zero (400 cases: +-0.1 is four sigmas), and
    # 0.7 % exceed 6; with nine weights chi-square is approximate.
    assert 0.35 < np.mean(gains < 0.02) < 0.75
    assert np.mean(gains > 6) < 0.03


def test_scores_have_mean_zero_and_unit_spread_where_nothing_is() -> None:
    rng = np.random.default_rng(4)
    scores = [
        system(*drawn(rng, np.zeros(WEIGHTS))).scores(np.ones((1, WEIGHTS)))[0] for _ in range(400)
    ]
    assert abs(np.mean(scores)) < 0.2  # four standard errors
    assert 0.8 < np.std(scores) < 1.2


@pytest.mark.parametrize("size", [0.05, 1.0, 20.0])
def test_sizes_are_found(size: float) -> None:
    rng, spectra = np.random.default_rng(5), np.ones((1, WEIGHTS))
    found = [
        system(*drawn(rng, np.full(WEIGHTS, size))).components(spectra).sizes[0] for _ in range(60)
    ]
    # The mean of 60 estimates from nine weights each: 6 % of the size, and some bias at zero.
    assert np.mean(found) == pytest.approx(size, rel=0.3)


def test_no_information_gives_no_size() -> None:
    nothing = WeightSystem(np.zeros((3, 3)), np.zeros(3))
    found = nothing.components(np.eye(3))
    assert not found.sizes.any()
    assert found.gain == 0


@pytest.mark.parametrize("left_of_it", [1e-29, 2.9e-15, -1.1e-27])
def test_a_process_of_which_only_rounding_is_left_is_not_there(left_of_it: float) -> None:
    """As of a clock that no motion shows: its information is a zero that was summed."""
    rng = np.random.default_rng(3)
    Z, y = drawn(rng, np.full(WEIGHTS, 4.0))
    clear = system(100 * Z, 100 * y)
    information, pull = clear.information.copy(), clear.pull.copy()
    information[-1] = information[:, -1] = 1e-12 * rng.standard_normal(WEIGHTS)
    information[-1, -1] = pull[-1] = left_of_it
    spectra = np.repeat(np.eye(2), [WEIGHTS - 1, 1], axis=1)
    found = WeightSystem(information, pull).components(spectra)
    assert found.sizes[0] > 0
    assert found.sizes[1] == 0


def test_information_that_rounding_made_indefinite_has_sizes_all_the_same() -> None:
    """As of a difference of informations of which little is left: off by 1e-8 of the largest."""
    rng = np.random.default_rng(4)
    axes, _ = np.linalg.qr(rng.standard_normal((WEIGHTS, WEIGHTS)))
    values = np.geomspace(1e-2, 1e6, WEIGHTS)
    values[0] = -1e-2
    information = (axes * values) @ axes.T
    pull = information @ (1e3 * rng.standard_normal(WEIGHTS))
    spectra = np.repeat(np.eye(2), [4, WEIGHTS - 4], axis=1)
    known = WeightSystem(0.5 * (information + information.T), pull)
    found = known.components(spectra)
    assert np.isfinite(found.sizes).all()
    assert found.gain > 0
    assert np.isfinite(known.fit(np.full(WEIGHTS, 1e4)).rest).all()
