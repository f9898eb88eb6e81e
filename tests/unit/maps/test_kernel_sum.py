"""Means of processes on blocks, point by point, against the formulas written out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.posterior import LEAST, exponentiate
from l2m_gtsam.maps.sliding_gp import KernelSums
from tests.support.central_differences import slopes

LENGTH_SCALE = 0.7  # m


def sums(rng: np.random.Generator, sizes: list[int]) -> KernelSums:
    """Return blocks about places some metres apart with so many training points each."""
    return KernelSums(
        length_scale=LENGTH_SCALE,
        centres=rng.uniform(-5, 5, (len(sizes), 3)),
        first=np.cumsum([0, *sizes]),
        y=rng.normal(0, 2, (3, sum(sizes))),
        alpha=rng.normal(0, 1, (3, sum(sizes))),
    )


def places(of: KernelSums, rng: np.random.Generator, count: int) -> tuple[FloatArray, IntArray]:
    """Return places near their blocks, and which these are."""
    block = rng.integers(0, len(of.centres), count)
    return of.centres[block] + rng.normal(0, 1, (count, 3)), block


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), sizes=st.lists(st.integers(1, 70), min_size=1, max_size=4))
def test_means_and_gradients_are_the_formulas(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    of = sums(rng, sizes)
    points, block = places(of, rng, 30)
    mean, gradient = of.mean_and_gradient(points, block)
    for n in range(30):
        own = slice(of.first[block[n]], of.first[block[n] + 1])
        d = (points[n] - of.centres[block[n]]) / LENGTH_SCALE - of.y[:, own].T
        k = np.exp(-0.5 * np.sum(d * d, axis=1))
        # Sums of at most 70 numbers of order one.
        np.testing.assert_allclose(mean[n], of.alpha[:, own] @ k, rtol=0, atol=1e-13)
        slope = -(of.alpha[:, own] * k) @ d / LENGTH_SCALE
        np.testing.assert_allclose(gradient[n], slope, rtol=0, atol=1e-12)


def test_the_gradient_is_the_derivative_of_the_mean() -> None:
    rng = np.random.default_rng(2)
    of = sums(rng, [80, 40])
    points, block = places(of, rng, 25)
    _, gradient = of.mean_and_gradient(points, block)
    expected = slopes(lambda x: of.mean_and_gradient(x, block)[0], points, 1e-5)
    # Central differences err by step^2 / 6 of the third derivative, about 1e-10 of the scale
    # here, and by rounding / step, about 1e-10 of it too.
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=3e-9 * scale)


@pytest.mark.parametrize("distance", [1e3, 1e9, 1e200, 1e308])
def test_far_away_the_mean_is_nothing_and_never_nan(distance: float) -> None:
    of = sums(np.random.default_rng(1), [20])
    points = distance * np.vstack([np.eye(3), -np.eye(3)])
    mean, gradient = of.mean_and_gradient(points, np.zeros(6, dtype=np.int64))
    # Of numbers down to the least that float64 holds nothing is left beside a field in uT.
    np.testing.assert_allclose(mean, 0.0, atol=1e-300)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-290)


def test_exponentials_are_those_of_the_library() -> None:
    v = np.concatenate([np.linspace(LEAST, 0, 200_001), -np.logspace(-300, 0, 1000), [-0.0]])
    found, powers = v.copy(), np.empty_like(v)
    exponentiate(found, powers, powers.view(np.int64))
    # Two units in the last place: the series is rounded once, the sum of its terms a few times.
    np.testing.assert_allclose(found, np.exp(v), rtol=4.5e-16, atol=0)
