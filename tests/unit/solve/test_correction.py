"""Readings corrected, and what is then known of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import Distortion, FloatArray
from l2m_gtsam.solve.correction import corrected
from tests.drives.calibrations import sensor

SEEDS = st.integers(0, 2**32 - 1)


def distortion(rng: np.random.Generator) -> Distortion:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Distortion(turn @ (np.eye(3) + rng.normal(0, 0.1, (3, 3))), rng.normal(0, 20, 3))


@given(SEEDS)
def test_what_was_distorted_comes_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, b = distortion(rng), rng.normal(0, 40, (50, 3))
    found = corrected(true.apply(b), true, np.zeros((12, 12)), np.zeros((50, 3)))
    # 200 uT at a condition of 2 or so, in double precision
    np.testing.assert_allclose(found.field, b, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.covariance, 0, atol=1e-20)


@given(SEEDS)
def test_the_covariance_is_that_of_finite_differences(seed: int) -> None:
    """Slow and independent: every number of z, C and H changed in turn, for every reading.

    Central differences of steps h leave h^2 times the third derivative, 1e-8 of the first here.
    """
    rng = np.random.default_rng(seed)
    made, z = distortion(rng), rng.normal(0, 50, (4, 3))
    covariance, h = sensor().covariance[3:, 3:], 1e-4
    variance = rng.uniform(0, 0.2, (4, 3))

    def undone(changed: FloatArray, reading: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.inv(changed[:9].reshape(3, 3)) @ (reading - changed[9:]))

    found = corrected(z, made, covariance, variance)
    for n, reading in enumerate(z):
        by_model, by_reading = np.zeros((3, 12)), np.zeros((3, 3))
        for k, step in enumerate(h * np.eye(12)):
            after = undone(made.vector() + step, reading)
            by_model[:, k] = (after - undone(made.vector() - step, reading)) / (2 * h)
        for k, step in enumerate(h * np.eye(3)):
            after = undone(made.vector(), reading + step)
            by_reading[:, k] = (after - undone(made.vector(), reading - step)) / (2 * h)
        expected = by_model @ covariance @ by_model.T
        expected += by_reading @ np.diag(variance[n]) @ by_reading.T
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found.covariance[n], expected, rtol=0, atol=1e-5 * scale)


def test_the_covariance_is_what_sampling_shows() -> None:
    """Sigmas of 40,000 draws are good to 0.35 %; terms of second order add 0.1 %."""
    rng = np.random.default_rng(4)
    made, b = distortion(rng), np.array([20.0, -10.0, 35.0])
    covariance = sensor().covariance[3:, 3:]
    z = made.apply(b)
    errors = rng.multivariate_normal(np.zeros(12), covariance, 40_000)
    draws = np.array(
        [
            Distortion.from_vector(made.vector() + e).undo((z + n)[None])[0]
            for e, n in zip(errors, rng.normal(0, 0.2, (40_000, 3)), strict=True)
        ]
    )
    found = corrected(z[None], made, covariance, np.full((1, 3), 0.2**2)).covariance[0]
    np.testing.assert_allclose(np.std(draws, axis=0), np.sqrt(np.diag(found)), rtol=0.02)


def test_a_missing_axis_leaves_nothing_known_and_harms_no_other() -> None:
    made = sensor()
    z = np.array([[20.0, 1.0, 2.0], [20.0, np.nan, 2.0], [3.0, 40.0, np.inf]])
    found = corrected(z, made.distortion, made.covariance[3:, 3:], np.ones((3, 3)))
    np.testing.assert_array_equal(
        np.isfinite(found.field), np.repeat([[True], [False], [False]], 3, axis=1)
    )
    assert np.isfinite(found.covariance[0]).all()
    assert np.isnan(found.covariance[1:]).all()


@pytest.mark.parametrize("readings", [0, 1])
def test_few_readings(readings: int) -> None:
    made = sensor()
    ones = np.ones((readings, 3))
    found = corrected(ones, made.distortion, made.covariance[3:, 3:], ones)
    assert found.field.shape == (readings, 3)
    assert found.covariance.shape == (readings, 3, 3)
