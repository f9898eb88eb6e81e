"""Fields of recorded numbers as shared errors: features, prior, and what weights mean."""

import gtsam
import numpy as np
import pytest

from l2m_factors import Q, shared_error
from l2m_gtsam.calibration.coverage import Correction, MovingFields, moving_fields
from l2m_gtsam.calibration.factor_graph import unit_priors
from l2m_gtsam.calibration.moving_solve import without
from l2m_gtsam.data import FloatArray, Readings


def readings(numbers: FloatArray | None) -> Readings:
    """Four readings of each of two sensors."""
    rng, sensor = np.random.default_rng(0), np.repeat([0, 1], 4)
    stamps, R = np.tile(np.arange(4), 2), np.tile(np.eye(3), (8, 1, 1))
    p, field = np.zeros((8, 3)), rng.normal(size=(8, 3))
    return Readings(("a", "b"), sensor, stamps, R, p, field, regressors=numbers)


NUMBERS = np.random.default_rng(1).normal([5, -300], [2, 40], (8, 2))


def test_a_weight_is_a_standard_deviation_of_the_number() -> None:
    """50 uT while the number is one standard deviation off: by its own spread at each sensor."""
    moving = moving_fields(readings(NUMBERS), 50.0)
    assert moving.sizes == {Q(0): 6, Q(1): 6}
    for sensor in (0, 1):
        q = NUMBERS[4 * sensor : 4 * sensor + 4]
        np.testing.assert_allclose(moving.scales[sensor] * q.std(axis=0), 50)
        weights = np.random.default_rng(2).normal(size=6)
        values = gtsam.Values()
        values.insert(Q(sensor), weights)
        found = shared_error(moving.errors(sensor, q), values)
        g = moving.scales[sensor][:, None] * weights.reshape(2, 3)
        np.testing.assert_allclose(found, q @ g, rtol=1e-12)


def test_sensors_that_feel_nothing_have_no_weights() -> None:
    one = NUMBERS.copy()
    one[4:] = 0
    moving = moving_fields(readings(one), 50.0)
    assert list(moving.sizes) == [Q(0)]
    assert moving.errors(1, one[4:]) == ()
    assert moving_fields(readings(None), 50.0).sizes == {}


def test_a_number_that_does_not_change_is_no_error() -> None:
    """It would be one with H."""
    numbers = NUMBERS.copy()
    numbers[:4, 1] = 7.0
    (error,) = (moving := moving_fields(readings(numbers), 50.0)).errors(0, numbers[:4])
    assert moving.scales[0][1] == 0
    assert not error.features[:, :, 3:].any()


def test_the_prior_is_of_unit_variance() -> None:
    moving = MovingFields({3: np.ones(2)})
    values = gtsam.Values()
    values.insert(Q(3), np.arange(6.0))
    graph = unit_priors(moving.sizes)
    assert graph.size() == 1
    # GTSAM's error is half of the sum of squares.
    assert graph.error(values) == pytest.approx(0.5 * np.sum(np.arange(6.0) ** 2))


def test_corrections_are_those_of_many_draws() -> None:
    """h = C g of 100,000 draws of the weights: sigmas to 1 %, means to 5 standard errors."""
    rng = np.random.default_rng(4)
    C = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    root, mean = rng.normal(size=(6, 6)), rng.normal(size=6)
    moving = MovingFields({0: np.array([2.0, 0.3])})
    found = moving.correction(0, mean, root @ root.T, C)
    draws = (mean + rng.normal(size=(100_000, 6)) @ root.T).reshape(-1, 2, 3)
    h = (draws * moving.scales[0][:, None]) @ C.T
    np.testing.assert_allclose(found.sigma, h.std(axis=0), rtol=0.01)
    np.testing.assert_allclose(found.h, h.mean(axis=0), atol=5 * found.sigma.max() / 300)


def test_fields_are_taken_off_where_they_are_felt() -> None:
    h = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.1]])
    given = readings(NUMBERS)
    bare = without(given, {1: Correction(h, np.zeros((2, 3)))})
    np.testing.assert_array_equal(bare.field[:4], given.field[:4])
    np.testing.assert_allclose(bare.field[4:] + NUMBERS[4:] @ h, given.field[4:], atol=1e-12)
    assert bare.regressors is not None
    assert not bare.regressors[:4].any()
    np.testing.assert_array_equal(bare.regressors[4:], NUMBERS[4:])
    assert without(given, {}).regressors is None
