"""Stretches that do not fit, and maps that are wrong for certain."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.slam.disturbances import ReadingFits, changed
from l2m_gtsam.slam.misfit import DecoyMap
from tests.support.central_differences import slopes
from tests.worlds.exact import BoundedWorld, dipole_world

KEY_POSES, SENSORS, READINGS = 200, 3, 3


def noise(seed: int, scale: float = 1.0) -> ReadingFits:
    """Return the fit of readings with nothing but noise, along 40 m."""
    rng = np.random.default_rng(seed)
    key = np.repeat(np.arange(KEY_POSES), SENSORS * READINGS)
    every = np.ones(len(key), dtype=np.bool_)
    return ReadingFits(
        key_pose=key,
        sensor=np.tile(np.repeat(np.arange(SENSORS), READINGS), KEY_POSES),
        inside=every,
        used=every,
        squared=scale * rng.chisquare(3, len(key)),
        p=np.column_stack([0.2 * np.arange(KEY_POSES), np.zeros((KEY_POSES, 2))]),
    )


@given(st.integers(0, 10_000), st.floats(0.3, 4.0))
def test_noise_is_no_change(seed: int, scale: float) -> None:
    """Also that of a map which errs a little more than it says, everywhere."""
    assert not changed(noise(seed, scale)).any()


@given(st.integers(20, 170), st.integers(9, 15))
def test_a_stretch_that_leaves_more_than_noise_is_left_out_with_what_lies_about_it(
    first: int, length: int
) -> None:
    fit = noise(1)
    there = (fit.key_pose >= first) & (fit.key_pose < first + length)
    about = changed(replace(fit, squared=np.where(there, 2.5 * fit.squared, fit.squared)))
    assert about[first : first + length].all()
    # 1.6 times as far as the stretch and a window of 1.8 m reach.
    rows = np.flatnonzero(about)
    assert rows[0] > first - 30
    assert rows[-1] < first + length + 30


def test_a_stretch_that_every_sensor_rejects_is_left_out() -> None:
    fit = noise(2)
    there = (fit.key_pose >= 100) & (fit.key_pose < 112)
    about = changed(replace(fit, used=~there))
    assert about[100:112].all()
    assert about.sum() < 60
    # One sensor may be wrong by itself.
    assert not changed(replace(fit, used=~(there & (fit.sensor == 1)))).any()


@pytest.mark.parametrize("seed", range(3))
def test_a_map_that_is_half_turned_has_the_field_of_the_other_side(seed: int) -> None:
    """And its gradient is that of its field."""
    world, rng = dipole_world(seed), np.random.default_rng(seed)
    middle = np.array([0.5, -0.3, 0.4])
    turned, x = DecoyMap(world, middle), rng.uniform([-3, -3, 0.3], [3, 3, 0.7], (20, 3))
    other = x * [-1, -1, 1] + [2 * 0.5, -2 * 0.3, 0]
    np.testing.assert_allclose(turned.query(x).field, world.query(other).field, atol=1e-12)
    _, gradient = turned.field_and_gradient(x)
    # Central differences of fields that bend over decimetres.
    expected = slopes(lambda points: turned.query(points).field, x, 1e-5)
    np.testing.assert_allclose(gradient, expected, atol=1e-4)


def test_a_map_that_is_half_turned_goes_on_beyond_its_data_as_the_map_does() -> None:
    """Solvers query places that the map does not know: numbers, not NaN."""
    inner, x = dipole_world(3), np.array([[-3.0, 0.5, 0.4], [3.0, 0.5, 0.4]])
    world = BoundedWorld(inner.uniform, inner.positions, inner.moments)
    turned = DecoyMap(world, np.zeros(3))
    assert turned.query(x).inside.tolist() == [False, True]
    field, gradient = turned.field_and_gradient(x)
    np.testing.assert_allclose(field, inner.query(x * [-1, -1, 1]).field, atol=1e-12)
    expected = slopes(lambda points: inner.query(points * [-1, -1, 1]).field, x, 1e-5)
    np.testing.assert_allclose(gradient, expected, atol=1e-4)
