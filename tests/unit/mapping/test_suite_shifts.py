"""What errors of a suite's sensors do to its readings: derivatives of what a map is given."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Readings, Trajectory
from l2m_gtsam.mapping.shifts import suite_covariance, suite_errors
from l2m_gtsam.mapping.suite_calibration import errors_in_common
from l2m_gtsam.mapping.suite_drive import parameters_of
from l2m_gtsam.mapping.suite_likelihood import TAU, Undistorted, undistorted
from l2m_gtsam.maps.suite_errors import SIZE
from l2m_gtsam.recording.sync import TWIST_S, with_offsets

STEP = 1e-5


def trajectory() -> Trajectory:
    """A smooth way with turns, pitch and heave, poses every 20 ms."""
    at = np.arange(0, 5, 0.02)
    R = Rotation.from_euler("ZYX", np.column_stack([at, 0.2 * np.sin(at), 0.1 * np.cos(at)]))
    p = np.column_stack([np.cos(at), np.sin(2 * at), 0.1 * np.sin(at)])
    return Trajectory((at * 1e9).astype(np.int64), R.as_matrix(), p, "map", "lidar")


def known(rng: np.random.Generator) -> list[KnownSensor]:
    return [
        KnownSensor(
            f"s{i}",
            rng.normal(0, 0.3, 3),
            Distortion(np.eye(3) + rng.normal(0, 0.1, (3, 3)), rng.normal(0, 5, 3)),
            float(rng.normal(0, 0.02)),
            np.diag(rng.uniform(0.1, 1, SIZE)),
        )
        for i in range(2)
    ]


def given(readings: Readings, sensors: list[KnownSensor]) -> FloatArray:
    """Return what a map is given of readings, shape (N, 6)."""
    offsets = np.array([each.time_offset for each in sensors])
    moved = with_offsets(readings, trajectory(), offsets)
    undone = as_known(moved, sensors)
    return np.hstack([undone.points, undone.field])


def as_known(readings: Readings, sensors: list[KnownSensor]) -> Undistorted:
    return undistorted(readings, np.stack([parameters_of(each) for each in sensors]))


def with_error(sensor: KnownSensor, k: int, step: float) -> KnownSensor:
    vector = np.append(sensor.vector(), sensor.time_offset)
    vector[k] += step
    return KnownSensor(
        sensor.sensor, vector[:3], Distortion.from_vector(vector[3:15]), float(vector[15])
    )


def test_shifts_are_the_derivatives_of_what_a_map_is_given() -> None:
    rng, count = np.random.default_rng(0), 40
    sensors, sensor = known(rng), np.arange(count) % 2
    # In the middle between two poses: a velocity is that of one piece of the way.
    stamps = 1_010_000_000 + np.sort(rng.choice(150, count, replace=False)) * 20_000_000
    stamps = stamps - np.array([round(s.time_offset * 1e9) for s in sensors])[sensor]
    bare = Readings(
        tuple(s.sensor for s in sensors),
        sensor,
        stamps,
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        rng.normal(0, 30, (count, 3)),
    )
    moving = with_offsets(bare, trajectory(), np.array([s.time_offset for s in sensors]))
    shift = suite_errors(moving, sensors, as_known(moving, sensors)).shift
    for k in range(SIZE):
        # A velocity is that over a while.
        step = TWIST_S / 2 if k == TAU else STEP
        plus, minus = (
            given(bare, [with_error(each, k, sign * step) for each in sensors]) for sign in (1, -1)
        )
        slope = (plus - minus) / (2 * step)
        # Second differences: of a step of 1e-5 of numbers up to a hundred, of 0.05 s with 2 rad/s.
        within = 1e-2 if k == TAU else 1e-5
        np.testing.assert_allclose(shift[:, :, k], slope, atol=within * (1 + np.abs(slope).max()))


def test_what_sensors_have_in_common_is_their_covariance() -> None:
    rng = np.random.default_rng(1)
    common = [rng.normal(size=(SIZE, 2)) for _ in range(3)]
    alone = [np.diag(rng.uniform(0.5, 1, SIZE)) for _ in range(3)]
    sensors = [
        KnownSensor(str(i), np.zeros(3), Distortion.identity(), 0.0, c @ c.T + a, c)
        for i, (c, a) in enumerate(zip(common, alone, strict=True))
    ]
    covariance = suite_covariance(sensors)
    for i in range(3):
        for j in range(3):
            block = covariance[SIZE * i : SIZE * (i + 1), SIZE * j : SIZE * (j + 1)]
            expected = common[i] @ common[j].T + (alone[i] if i == j else 0)
            np.testing.assert_allclose(block, expected, atol=1e-12)


def test_an_exact_sensor_beside_others_has_no_errors() -> None:
    exact = KnownSensor.ideal("exact")
    (other, _) = known(np.random.default_rng(2))
    covariance = suite_covariance([exact, other])
    assert not covariance[:SIZE].any()
    assert covariance[SIZE:, SIZE:] == pytest.approx(other.covariance)


def test_errors_in_common_are_found_in_a_joint_covariance() -> None:
    """A height that all sensors share, and errors of their own."""
    count = 3
    own = np.diag(np.tile(np.repeat([0.001, 0.01, 0.2, 0.001], [3, 9, 3, 1]) ** 2, count))
    height = np.zeros(SIZE * count)
    height[2::SIZE] = 0.1
    joint = own + np.outer(height, height)
    root = errors_in_common(joint)
    np.testing.assert_allclose(np.abs(root).max(axis=0), 0.1, rtol=0.01)
    left = joint - root @ root.T
    assert np.linalg.eigvalsh(left).min() > -1e-12
    np.testing.assert_allclose(np.diag(left), np.diag(own), rtol=0.7)
    assert errors_in_common(np.diag(np.arange(1.0, SIZE + 1))).shape == (SIZE, 0)
