"""What is learnt of one field, and of each sensor that reads it, at known places."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.tiles import relative_place
from l2m_gtsam.slam.unknown_field.wave_prior import (
    NAMES,
    WaveLikelihood,
    box_about,
    heard_waves,
    learnt_waves,
    sensor_columns,
    waves_above,
)
from l2m_gtsam.solve.linear_algebra import covariance_root
from tests.drives.slam import calibrated, rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

SENSORS = 2
TRUE = Hyperparameters(floor_scale=6.0, floor_depth=0.7, ceiling_scale=0.5, ceiling_depth=1.5)
NOISE = np.array([0.1, 0.4])
CHANGE = np.array([0.0, 3.0])  # of H along one axis, uT
STEP = 1e-5


@pytest.fixture(scope="module")
def drive() -> Drive:
    """A drive whose calibrations are known to a little."""
    sensors = random_sensors(3, SENSORS)
    recorded = slam_drive(dipole_world(1), sensors, rounds(25.0), np.random.default_rng(3))
    options = SlamOptions.model_validate({"key_poses": {"distance_m": 0.3, "readings": 2}})
    sigma = np.concatenate([np.full(3, 1e-6), np.full(9, 0.003), np.full(3, 0.1)])
    found, _ = prepared(recorded.recording, calibrated(sensors, sigma=sigma), options)
    return found


@pytest.fixture(scope="module")
def poses(drive: Drive) -> list[gtsam.Pose3]:
    return drive.dead_reckoning()


def columns_of(drive: Drive, poses: list[gtsam.Pose3], basis: WaveBasis) -> list[FloatArray]:
    """Return what weights, calibrations' errors and changes of H add to each sensor's readings."""
    found = []
    for k in range(SENSORS):
        where = relative_place(
            drive.readings[np.flatnonzero(drive.readings.sensor == k)], poses, 0, drive.sensors
        )
        root = covariance_root(drive.sensors.covariance[k, 3:, 3:])
        found.append(sensor_columns(where, drive.sensors, k, root, basis)[0])
    return found


def test_the_likelihood_is_that_of_a_normal_density(drive: Drive, poses: list[gtsam.Pose3]) -> None:
    """Differences between hyperparameters, and slopes, against the definition."""
    basis = WaveBasis.over(box_about(drive, poses), Resolution(2.5, 1.5))
    likelihood, m = WaveLikelihood(drive, poses, basis), len(basis)
    columns = columns_of(drive, poses, basis)
    own = [np.flatnonzero(drive.readings.sensor == k) for k in range(SENSORS)]
    z = [
        (drive.readings.field[rows] - drive.sensors.distortion[k, 9:]).ravel()
        for k, rows in enumerate(own)
    ]

    def by_definition(at: FloatArray) -> float:
        values = np.exp(at)
        known = TRUE.model_copy(update=dict(zip(NAMES, values[:4].tolist(), strict=True)))
        scale = np.exp(0.5 * basis.prior(known).log_variance)
        noise, change = np.split(values[4:], 2)
        K = np.vstack([each[:, :m] * scale for each in columns])
        K = K @ K.T
        begin = 0
        for k, each in enumerate(columns):
            rows = slice(begin, begin + len(each))
            errors = each[:, m:] * np.repeat([1.0, change[k]], [12, 3])
            K[rows, rows] += errors @ errors.T + noise[k] ** 2 * np.eye(len(each))
            begin += len(each)
        return -float(multivariate_normal(np.zeros(len(K)), K).logpdf(np.concatenate(z)))

    one = np.log([4.0, 0.6, 1.0, 2.0, 0.2, 0.5, 0.3, 2.0])
    other = one + np.random.default_rng(5).normal(0, 0.5, len(one))
    found = likelihood.cost_and_slopes(other)[0] - likelihood.cost_and_slopes(one)[0]
    assert found == pytest.approx(by_definition(other) - by_definition(one), rel=1e-5)
    slopes = likelihood.cost_and_slopes(other)[1]
    ends = [
        [likelihood.cost_and_slopes(other + by * step)[0] for by in (1.0, -1.0)]
        for step in STEP * np.eye(len(one))
    ]
    by_differences = (np.array(ends)[:, 0] - np.array(ends)[:, 1]) / (2 * STEP)
    # Rounding: of sums of squares of 50 uT in noise of 0.2 uT, over the step.
    np.testing.assert_allclose(slopes, by_differences, rtol=1e-4, atol=2e-3)


def test_field_noise_and_changed_offsets_are_learnt(drive: Drive, poses: list[gtsam.Pose3]) -> None:
    """Readings drawn from the model: each is found within what its size leaves open."""
    frame, rng = box_about(drive, poses), np.random.default_rng(6)
    basis = WaveBasis.over(frame, Resolution(7.0, 4.0))
    weights = np.exp(0.5 * basis.prior(TRUE).log_variance) * rng.normal(size=len(basis))
    weights[:3] = [15.0, -8.0, -40.0]
    field = drive.readings.field.copy()
    for k, columns in enumerate(columns_of(drive, poses, basis)):
        rows = np.flatnonzero(drive.readings.sensor == k)
        b = (columns[:, : len(basis)] @ weights).reshape(-1, 3)
        noise = NOISE[k] * rng.normal(size=b.shape)
        field[rows] = b + drive.sensors.distortion[k, 9:] + noise + [CHANGE[k], 0.0, 0.0]
    read = replace(drive, readings=replace(drive.readings, field=field))
    found = learnt_waves(read, poses, basis)
    # 500 numbers of each sensor; some hundred weights; three numbers of a change.
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.15)
    assert found.hyperparameters.floor_scale == pytest.approx(TRUE.floor_scale, rel=0.35)
    assert found.hyperparameters.floor_depth == pytest.approx(TRUE.floor_depth, rel=0.15)
    assert found.offset[0] < 0.3
    assert 0.7 < found.offset[1] < 5.0
    change = (found.sensors - drive.sensors.vectors())[:, 12:]
    np.testing.assert_allclose(change[:, 0], CHANGE, atol=0.4)  # calibrations are good to 0.1 uT


def test_waves_are_left_out_that_are_weaker_than_noise(
    drive: Drive, poses: list[gtsam.Pose3]
) -> None:
    frame, noisy = box_about(drive, poses), TRUE.model_copy(update={"noise": 0.5})
    quiet = TRUE.model_copy(update={"noise": 0.05})
    few, many = (heard_waves(each, frame, 10_000, 1.0) for each in (noisy, quiet))
    assert few is not None
    assert many is not None
    assert few.floor < many.floor
    # With less than that, the weakest of both sides are left out, until these would be strong.
    edge = float(np.sqrt(np.prod(frame.size)))
    less = heard_waves(quiet, frame, int(0.92 * many.modes(edge)), 1.0)
    assert less is not None
    assert waves_above(quiet, 2.0 * quiet.noise).floor <= less.floor < many.floor
    assert heard_waves(quiet, frame, 10, 1.0) is None
