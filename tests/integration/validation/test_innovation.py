"""White innovations over a map that knows its errors, against a covariance written out in full."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from l2m_factors import skew
from l2m_gtsam.calibration.pose_errors import pose_seconds
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.qa.metrics.coordinates import changes_of
from l2m_gtsam.validation.innovation import (
    KnownCalibration,
    change_likelihood,
    marginalise_calibration,
)
from tests.drives.calibrations import SIGMA
from tests.drives.uncertain import (
    NOISE,
    WORLD,
    all_features,
    own_noise,
    small_sensors,
    surveyed,
    turning_poses,
)

SENSOR = small_sensors(1)[0]
COUNT = 60
LASTS_S = 1.0


@pytest.fixture(scope="module")
def field_map() -> HarmonicMap:
    return surveyed(0, 500)


@pytest.fixture(scope="module")
def readings() -> Readings:
    """A drive over the survey, with a recorded number."""
    rng = np.random.default_rng(1)
    R, p = turning_poses(rng, COUNT)
    B, _ = WORLD.field_and_gradient(R @ SENSOR.t_lidar_mag + p)
    field = SENSOR.distortion.apply(np.einsum("nji,nj->ni", R, B))
    return Readings(
        (SENSOR.sensor,),
        np.zeros(COUNT, dtype=np.int64),
        np.arange(COUNT) * 50_000_000,
        R,
        p,
        field + rng.normal(0, NOISE, (COUNT, 3)),
        regressors=rng.normal(size=(COUNT, 1)),
    )


def known(number_sigma: float = 0.0) -> KnownCalibration:
    rng = np.random.default_rng(3)
    vector = np.append(SENSOR.vector() + rng.normal(size=15) * SIGMA, 0.0)
    return KnownCalibration(vector, NOISE, np.full((1, 3), number_sigma))


def prediction(readings: Readings, field_map: HarmonicMap, vector: FloatArray) -> FloatArray:
    """Return what the sensor should read in uT, all readings in a row, shape (3 N,)."""
    x = readings.R_map_lidar @ vector[:3] + readings.p_map_lidar
    B, _ = field_map.field_and_gradient(x)
    b = np.einsum("nji,nj->ni", readings.R_map_lidar, B)
    return np.asarray(b @ vector[3:12].reshape(3, 3).T + vector[12:15]).ravel()


def dense(
    readings: Readings, field_map: HarmonicMap, calibration: KnownCalibration, P: FloatArray
) -> FloatArray:
    """Return the covariance of all innovations, (3 N, 3 N): noise, map, numbers, calibration."""
    vector, R = calibration.vector, readings.R_map_lidar
    C, x = vector[3:12].reshape(3, 3), R @ vector[:3] + readings.p_map_lidar
    CR = C @ R.transpose(0, 2, 1)
    modes = field_map.errors_over(x)
    A = all_features(modes, x)
    shared = (CR @ A).reshape(3 * len(x), -1)
    S = block_diag(*own_noise(field_map, x, A, CR)) + shared @ modes.covariance @ shared.T
    assert readings.regressors is not None
    q = np.kron(readings.regressors, np.eye(3))
    S += q @ np.diag(calibration.number_sigma[0] ** 2) @ q.T
    B, G = field_map.field_and_gradient(x)
    b, J = np.einsum("nji,nj->ni", R, B), np.zeros((len(x), 3, 15))
    J[:, :, :3], J[:, :, 12:] = CR @ G @ R, np.eye(3)
    for n in range(len(x)):
        J[n, :, 3:12] = np.kron(np.eye(3), b[n])
    by_calibration = J.reshape(-1, 15)
    return np.asarray(S + by_calibration @ P[:15, :15] @ by_calibration.T)


@pytest.mark.parametrize("number_sigma", [0.0, 0.3])
def test_the_square_is_that_of_the_full_covariance(
    readings: Readings, field_map: HarmonicMap, number_sigma: float
) -> None:
    calibration = known(number_sigma)
    P = np.zeros((16, 16))
    P[:15, :15] = np.diag(SIGMA**2)
    e = readings.field.ravel() - prediction(readings, field_map, calibration.vector)
    S = dense(readings, field_map, calibration, P)
    told = change_likelihood((readings,), field_map, (calibration,), LASTS_S)
    found = marginalise_calibration(told, P, changes_of(np.eye(3)))
    assert found.squared == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-8)
    independent = NOISE**-2 * float(e @ e)
    assert found.squared < 0.8 * independent


def test_sensors_share_the_errors_of_the_map(readings: Readings, field_map: HarmonicMap) -> None:
    """Two at one place: the map is wrong once, not twice; written out with both in a row."""
    first = known()
    second = replace(first, vector=first.vector + np.append(np.full(3, 0.01), np.zeros(13)))
    R, both = readings.R_map_lidar, (first, second)
    e = np.concatenate(
        [readings.field.ravel() - prediction(readings, field_map, each.vector) for each in both]
    )
    x = np.concatenate([R @ each.vector[:3] + readings.p_map_lidar for each in both])
    CR = np.concatenate([each.vector[3:12].reshape(3, 3) @ R.transpose(0, 2, 1) for each in both])
    modes = field_map.errors_over(x)
    A = all_features(modes, x)
    shared = (CR @ A).reshape(3 * len(x), -1)
    S = block_diag(*own_noise(field_map, x, A, CR)) + shared @ modes.covariance @ shared.T
    found = change_likelihood((readings, readings), field_map, (first, second), LASTS_S)
    assert found.squared == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-6)
    assert found.root.shape == (32, 32)


def test_errors_of_poses_last(readings: Readings, field_map: HarmonicMap) -> None:
    """With the covariance of the poses' errors over the whole drive, written out in full."""
    root = np.diag(np.repeat([0.01, 0.02], 3))
    calibration, P = known(), np.zeros((16, 16))
    vector = calibration.vector
    # in one tile of the map: from one to the next the solve's shortcut forgets within a second
    place = readings.R_map_lidar @ vector[:3] + readings.p_map_lidar
    tile = field_map.errors_over(place).owner(place)
    readings = readings.select(tile == np.bincount(tile).argmax())
    R, count = readings.R_map_lidar, len(readings)
    assert count > 8
    moved = replace(readings, pose_root=np.broadcast_to(root, (count, 6, 6)))
    e = readings.field.ravel() - prediction(readings, field_map, vector)
    B, G = field_map.field_and_gradient(R @ vector[:3] + readings.p_map_lidar)
    slope = R.transpose(0, 2, 1) @ G @ R
    b = np.einsum("nji,nj->ni", R, B)
    turn = skew(b) - slope @ skew(np.broadcast_to(vector[:3], b.shape))
    F = vector[3:12].reshape(3, 3) @ np.concatenate([turn, slope], axis=2) @ root
    seconds = pose_seconds(readings)
    alike = np.exp(-np.abs(seconds[:, None] - seconds) / LASTS_S)
    F = F.reshape(3 * count, 6)
    S = dense(readings, field_map, calibration, P) + F @ F.T * np.kron(alike, np.ones((3, 3)))
    found = change_likelihood((moved,), field_map, (calibration,), LASTS_S)
    assert found.squared == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-6)
