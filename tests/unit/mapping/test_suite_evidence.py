"""Slopes and information of a survey's likelihood by its sensors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray, LidarMotion, Readings
from l2m_gtsam.mapping.suite_likelihood import (
    SIZE,
    SuiteWindow,
    late_slopes,
    suite_likelihood,
    undistorted,
    window_slopes,
)
from tests.worlds.harmonic import GIVEN, TILTED, basis, places

SENSORS = 2
TIMED = 15  # of the time offset, which moves poses


def window(count: int = 40) -> SuiteWindow:
    """Readings of a field drawn from the prior, by sensors without distortion at the lidar."""
    rng, model = np.random.default_rng(5), basis()
    p = places(count, 2) @ TILTED.T + model.frame.corner
    R = Rotation.from_rotvec(rng.normal(0, 0.4, (count, 3))).as_matrix()
    w = np.exp(0.5 * model.prior(GIVEN).log_variance) * rng.normal(size=len(model))
    field = np.einsum("nji,nj->ni", R, model.features(p) @ w)
    field += GIVEN.noise * rng.normal(size=field.shape)
    sensor = np.sort(np.arange(count) % SENSORS)
    motion = LidarMotion.steady(rng.normal(0, 0.5, (count, 6)))
    stamps = np.arange(count) * 50_000_000
    readings = Readings(("a", "b"), sensor, stamps, R, p, field, motion)
    return SuiteWindow(model, p.mean(axis=0), readings)


def at_clocks(readings: Readings, offset: FloatArray) -> Readings:
    """Return the readings with the poses that their motion leads to."""
    assert readings.motion is not None
    w, v = readings.motion.twist_lidar[:, :3], readings.motion.twist_lidar[:, 3:]
    own = offset[readings.sensor, None]
    R = readings.R_map_lidar
    return replace(
        readings,
        R_map_lidar=R @ Rotation.from_rotvec(w * own).as_matrix(),
        p_map_lidar=readings.p_map_lidar + np.einsum("nij,nj->ni", R, v * own),
    )


def somewhere() -> FloatArray:
    """Sensors beside the lidar, a little distorted; clocks as they are."""
    sensors = np.tile(np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(4)]), (SENSORS, 1))
    sensors[:, :TIMED] += 0.02 * np.random.default_rng(6).normal(size=(SENSORS, TIMED))
    return sensors


def value(part: SuiteWindow, sensors: FloatArray) -> float:
    moved = at_clocks(part.readings, sensors[:, TIMED])
    return suite_likelihood(replace(part, readings=moved), sensors, GIVEN).value


def test_a_clock_that_is_late_all_the_time_is_a_time_offset() -> None:
    part, sensors = window(), somewhere()
    at = window_slopes(part, sensors, GIVEN)
    found = late_slopes(part, at, np.ones(len(part.readings)), SENSORS)
    np.testing.assert_allclose(found, at.slopes[:, :, TIMED::SIZE], atol=1e-12)
    grown = late_slopes(part, at, np.linspace(-1, 1, len(part.readings)), SENSORS)
    assert not np.allclose(grown, 0)


def test_the_likelihood_is_that_of_the_dense_process() -> None:
    """Against the normal density of what sensors read, with the covariance of all readings."""
    part, sensors = window(12), somewhere()
    seen = undistorted(part.readings, sensors)
    points = seen.points - seen.points.mean(axis=0) + part.middle
    F = part.basis.features(points).reshape(-1, len(part.basis))
    variance = np.exp(part.basis.prior(GIVEN).log_variance)
    covariance = (F * variance) @ F.T + GIVEN.noise**2 * np.eye(len(F))
    # Of what was read, not of the field behind it: each is turned by C of its sensor.
    C = sensors[part.readings.sensor, 3:12].reshape(-1, 3, 3)
    density = multivariate_normal(np.zeros(len(F)), covariance).logpdf(seen.field.ravel())
    expected = density - np.log(np.abs(np.linalg.det(C))).sum()
    assert suite_likelihood(part, sensors, GIVEN).value == pytest.approx(expected, rel=1e-9)


def test_slopes_are_those_of_the_likelihood() -> None:
    """Central differences err by their step squared, here about 1e-5 of the largest slope."""
    part, sensors = window(), somewhere()
    slope = suite_likelihood(part, sensors, GIVEN).slope.reshape(SENSORS, SIZE)
    differences, step = np.empty_like(slope), 1e-5
    for index in np.ndindex(*slope.shape):
        more, less = sensors.copy(), sensors.copy()
        more[index] += step
        less[index] -= step
        differences[index] = (value(part, more) - value(part, less)) / (2 * step)
    np.testing.assert_allclose(slope, differences, rtol=1e-4, atol=1e-4 * np.abs(slope).max())


def test_information_is_what_slopes_of_many_draws_vary_by() -> None:
    """At the truth slopes have the mean zero and the information as their covariance.

    Over 400 draws a variance is known to 7 %; 30 % is four of these sigmas. C and the place also
    change how far the field could spread, which adds a little that the expected information of the
    residuals leaves out.
    """
    part, draws = window(), []
    truth = np.tile(np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(4)]), (SENSORS, 1))
    model, rng = part.basis, np.random.default_rng(8)
    F, R = model.features(part.readings.p_map_lidar), part.readings.R_map_lidar
    prior = np.exp(0.5 * model.prior(GIVEN).log_variance)
    information = []
    for _ in range(400):
        field = np.einsum("nji,nj->ni", R, F @ (prior * rng.normal(size=len(model))))
        field += GIVEN.noise * rng.normal(size=field.shape)
        found = suite_likelihood(
            replace(part, readings=replace(part.readings, field=field)), truth, GIVEN
        )
        draws.append(found.slope)
        information.append(np.diag(found.information))
    told, varied = np.mean(information, axis=0), np.var(draws, axis=0)
    assert np.all(np.abs(np.mean(draws, axis=0)) < 4 * np.sqrt(varied / 400))
    # H and the clock take no part in how far the field spreads: theirs is exact.
    exact = np.tile(np.arange(SIZE) >= 12, SENSORS)
    np.testing.assert_allclose(varied[exact], told[exact], rtol=0.3)
    assert np.all(varied > 0.7 * told)


def test_how_high_a_drive_is_taken_to_be_says_nothing() -> None:
    """The waves' prior knows heights; sensors that all sit higher are as likely as before."""
    part, sensors = window(), somewhere()
    level = np.tile(np.eye(3), (len(part.readings), 1, 1))
    straight = replace(part, readings=replace(part.readings, R_map_lidar=level))
    higher = sensors + np.where(np.arange(SIZE) < 3, 0.3, 0.0)
    same = suite_likelihood(straight, sensors, GIVEN).value
    assert suite_likelihood(straight, higher, GIVEN).value == pytest.approx(same, abs=1e-6)
