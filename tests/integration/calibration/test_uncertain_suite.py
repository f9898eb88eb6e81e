"""Errors of the survey's sensors are part of a calibration's: over many surveys, each its own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, LidarMotion, Readings
from l2m_gtsam.mapping.shifts import suite_errors
from l2m_gtsam.mapping.suite_drive import parameters_of
from l2m_gtsam.mapping.suite_likelihood import undistorted
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from tests.drives.uncertain import (
    GIVEN,
    NOISE,
    OPTIONS,
    SENSORS,
    STARTS,
    WORLD,
)

# What a good suite is known to: 3 mm, 0.5 % and 0.3 degrees, 0.3 uT.
SIGMA = np.repeat([0.003, 0.005, 0.3, 0.0], [3, 9, 3, 1])
SOLVE = OneKeyOptions(sensor_noise_ut=NOISE)


def survey(seed: int, stated: bool = True) -> HarmonicMap:
    """Return the map of two sensors that turn and tilt, each off by a draw of its sigmas.

    They are known as stated, or taken for exact.
    """
    rng, count = np.random.default_rng(seed), 700
    ideal = [
        KnownSensor(name, np.array(t), Distortion.identity(), 0.0, np.diag(SIGMA**2))
        for name, t in (("a", (0.1, 0.05, 0.0)), ("b", (-0.1, 0.0, 0.1)))
    ]
    sensor = np.arange(count) % 2
    angles = np.column_stack([rng.uniform(-np.pi, np.pi, count), rng.normal(0, 0.15, (count, 2))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    p = rng.uniform([-1.4, -1.4, 0.2], [1.4, 1.4, 0.8], (count, 3))
    wrong = [off(each, SIGMA * rng.standard_normal(16)) for each in ideal]
    field = np.empty((count, 3))
    for index, truth in enumerate(wrong):
        rows = sensor == index
        B, _ = WORLD.field_and_gradient(R[rows] @ truth.t_lidar_mag + p[rows])
        field[rows] = truth.distortion.apply(np.einsum("nji,nj->ni", R[rows], B))
    field += rng.normal(0, GIVEN.noise, field.shape)
    still = LidarMotion.steady(np.zeros((count, 6)))
    read = Readings(("a", "b"), sensor, np.arange(count) * 10**8, R, p, field, motion=still)
    undone = undistorted(read, np.stack([parameters_of(each) for each in ideal]))
    suite = suite_errors(read, ideal, undone) if stated else None
    return HarmonicMap.fit(undone.points, undone.field, OPTIONS, suite=suite)


def off(sensor: KnownSensor, error: FloatArray) -> KnownSensor:
    """Return the sensor as it is when what is known of it is wrong by an error."""
    known = sensor.distortion.vector()
    distortion = Distortion.from_vector(known + error[3:15])
    return KnownSensor(sensor.sensor, sensor.t_lidar_mag + error[:3], distortion)


def distances(solution: OneKeySolution) -> list[float]:
    """Return the squared distances of all fifteen parameters from the truth, a sensor each."""
    found = []
    for each in solution.solved:
        e = solution.estimate.vector(each.sensor) - SENSORS[each.sensor].vector()
        found.append(float(e @ np.linalg.solve(each.covariance, e)))
    return found


@pytest.mark.parametrize("surveys", [3, pytest.param(12, marks=pytest.mark.study)])
def test_a_suite_that_is_off_as_stated_makes_true_sigmas(readings: Readings, surveys: int) -> None:
    found = []
    for seed in range(surveys):
        solution = solve_one_key(readings, survey(seed), STARTS, SOLVE)
        assert not solution.unsettled | solution.stayed
        found.append(np.mean(distances(solution)))
    # 15 are expected. Both sensors share the survey's errors and the drive its noise, so that a
    # survey counts as one draw of 15 degrees of freedom: the bounds are left once in 400.
    freedom = 15 * surveys
    low, high = (float(chi2.ppf(share, freedom)) / surveys for share in (0.00125, 0.99875))
    assert low < np.mean(found) < high


def test_a_suite_that_is_off_and_taken_for_exact_makes_sigmas_too_small(readings: Readings) -> None:
    found = [
        distances(solve_one_key(readings, survey(seed, stated=False), STARTS, SOLVE))
        for seed in (0, 1)
    ]
    assert np.mean(found) > 40
