"""Coordinates of a change: what happens to a sensor, however far, and its derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.coordinates import (
    COLUMNS,
    PARAMETERS,
    changed_vector,
    changes_of,
)
from l2m_gtsam.qa.metrics.mounting import gains, skews_deg
from l2m_gtsam.records.validation import CalibrationPart

SEEDS = st.integers(0, 10_000)


def calibration(seed: int) -> FloatArray:
    """A sensor whose axes are neither alike nor orthogonal, shape (16,)."""
    rng = np.random.default_rng(seed)
    C = (np.eye(3) + rng.normal(0, 0.05, (3, 3))) @ Rotation.random(rng=rng).as_matrix()
    return np.concatenate([rng.normal(0, 0.3, 3), C.ravel(), rng.normal(0, 15, 3), [0.01]])


@given(SEEDS, st.floats(0, 60))
def test_a_sensor_that_is_turned_has_turned_and_nothing_else(seed: int, degrees: float) -> None:
    """It reads C R^T of the vehicle's field, with the gains and angles it had before."""
    vector, rng = calibration(seed), np.random.default_rng(seed + 1)
    C = vector[3:12].reshape(3, 3)
    axis = rng.standard_normal(3)
    turn = Rotation.from_rotvec(degrees * axis / np.linalg.norm(axis), degrees=True)
    U, _, Vt = np.linalg.svd(C)
    about_own_axes = (U @ Vt) @ turn.as_rotvec(degrees=True)
    change = np.zeros(PARAMETERS)
    change[COLUMNS[CalibrationPart.ROTATION]] = about_own_axes
    after = changed_vector(vector, change)
    turned = after[3:12].reshape(3, 3)
    np.testing.assert_allclose(turned, C @ turn.as_matrix().T, atol=1e-12)
    np.testing.assert_allclose(gains(turned), gains(C), atol=1e-12)
    # An arcsine near zero is exact to rounding of cosines.
    np.testing.assert_allclose(skews_deg(turned), skews_deg(C), atol=1e-9)
    np.testing.assert_array_equal(np.delete(after, range(3, 12)), np.delete(vector, range(3, 12)))


@given(SEEDS)
def test_derivatives_are_those_of_central_differences(seed: int) -> None:
    """About any change; truncated to the square of the step, of second derivatives near one."""
    vector, rng = calibration(seed), np.random.default_rng(seed + 2)
    size = np.repeat([0.1, 20.0, 0.1, 5.0, 5.0, 0.05], [3, 3, 3, 3, 3, 1])
    change = size * rng.uniform(-1, 1, PARAMETERS)
    step = 1e-5 * size
    central = [
        (changed_vector(vector, change + e) - changed_vector(vector, change - e)) / (2 * e.max())
        for e in np.diag(step)
    ]
    C = vector[3:12].reshape(3, 3)
    np.testing.assert_allclose(changes_of(C, change), np.transpose(central), atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_no_change_leaves_a_calibration_as_it_is(seed: int) -> None:
    vector = calibration(seed)
    np.testing.assert_allclose(changed_vector(vector, np.zeros(PARAMETERS)), vector, atol=1e-12)
