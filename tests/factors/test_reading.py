"""The magnetic reading factors: derivatives, batching, and the two forms of one mathematics."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_factors import (
    BatchedReadings,
    D,
    PoseMotion,
    S,
    T,
    assert_jacobians_match,
    block_factor,
    distortion_prior,
    held_directions,
    moved,
    reading_factor,
)
from l2m_gtsam.data import FloatArray
from tests.support.factor_inputs import CountingWorld, as_magnetic, random_values, with_motion
from tests.worlds.exact import dipole_world, drive, random_sensors


def fixed_distortion(values: gtsam.Values, sensors: int) -> FloatArray:
    return np.stack([values.atVector(D(i)) for i in range(sensors)])


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000))
def test_jacobians_match_central_differences(seed: int) -> None:
    """Random poses, translations and distortions; 1e-6 of the largest entry (issue contract)."""
    world, sensors = dipole_world(seed), random_sensors(seed, 2)
    readings = as_magnetic(drive(seed, sensors, world, count=3, tilt=0.5))
    values = random_values(seed, 2)
    noise = gtsam.noiseModel.Gaussian.Covariance(np.diag([0.1, 0.2, 0.3]) + 0.02)
    joint = BatchedReadings(world, readings)
    timed = BatchedReadings(world, with_motion(readings, seed))
    alone = BatchedReadings(world, readings, fixed_distortion(values, 2))
    whitening = np.broadcast_to(np.linalg.cholesky(np.diag([3.0, 4.0, 5.0]) + 1), (6, 3, 3))
    factors = (
        reading_factor(joint, 1, noise),
        reading_factor(alone, 4, noise),
        block_factor(joint, 0, whitening),
        reading_factor(timed, 4, noise),
        block_factor(timed, 1, whitening),
        block_factor(alone, 1, whitening),
    )
    for factor in factors:
        assert_jacobians_match(factor, values, rtol=1e-6, step=2e-5)


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000))
def test_white_jacobians_are_those_of_the_factor(seed: int) -> None:
    """Column by column in the order of the keys, with a time offset and without, C fixed or not."""
    world, sensors = dipole_world(seed), random_sensors(seed, 2)
    readings, values = as_magnetic(drive(seed, sensors, world, count=4)), random_values(seed, 2)
    W = np.tril(np.random.default_rng(seed).normal(size=(8, 3, 3)))
    for batch in (
        BatchedReadings(world, readings),
        BatchedReadings(world, with_motion(readings, seed)),
        BatchedReadings(world, readings, fixed_distortion(values, 2)),
    ):
        rows = batch.rows_of(1)
        parts = batch.white_jacobians(batch.residuals(values, 1), rows, W[rows])
        whole = batch.jacobian(batch.residuals(values, 1))[rows]
        expected = (W[rows] @ whole).reshape(3 * len(rows), -1)
        # Products of three numbers, summed in another order.
        np.testing.assert_allclose(np.hstack(parts), expected, rtol=1e-12, atol=1e-10)


def test_prior_jacobians_match() -> None:
    rng = np.random.default_rng(5)
    values = random_values(5, 1)
    assert_jacobians_match(distortion_prior(0, np.eye(3), 0.3), values)
    assert_jacobians_match(held_directions(0, rng.normal(size=(2, 15)), np.zeros(15)), values)


def test_check_catches_a_wrong_jacobian() -> None:
    """The paper prints R C grad M; on a turned vehicle the check must refuse it."""
    world, sensors = dipole_world(1), random_sensors(1, 1)
    readings = as_magnetic(drive(1, sensors, world, count=1))
    values = random_values(1, 1)
    batch = BatchedReadings(world, readings, fixed_distortion(values, 1))

    def papers(
        _: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        residuals = batch.residuals(at, 0)
        if jacobians is not None:
            R, t = readings.R_map_lidar[0], at.atPoint3(T(0))
            G = world.field_and_gradient((R @ t + readings.p_map_lidar[0])[None])[1]
            jacobians[0] = np.asarray(R @ values.atVector(D(0))[:9].reshape(3, 3) @ G[0])
        return np.asarray(residuals.residual[0])

    factor = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [T(0)], papers)
    with pytest.raises(AssertionError, match="Jacobian by T0"):
        assert_jacobians_match(factor, values)


def test_one_map_query_per_linearisation() -> None:
    sensors = random_sensors(2, 3)
    counting = CountingWorld(dipole_world(2))
    readings = as_magnetic(drive(2, sensors, counting.world, count=20))
    batch = BatchedReadings(counting, readings)
    graph = gtsam.NonlinearFactorGraph()
    for n in range(len(batch)):
        graph.add(reading_factor(batch, n, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    values = random_values(2, 3)
    graph.error(values)
    graph.linearize(values)
    assert counting.calls == 1
    values.update(T(1), np.array([0.1, 0.2, 0.3]))
    graph.linearize(values)
    assert counting.calls == 2
    values.update(D(2), np.arange(12.0))
    graph.error(values)
    assert counting.calls == 3


def test_a_factor_alone_needs_only_its_own_sensor() -> None:
    world, sensors = dipole_world(3), random_sensors(3, 2)
    readings = as_magnetic(drive(3, sensors, world, count=4))
    batch = BatchedReadings(world, readings)
    values = gtsam.Values()
    values.insert(T(1), sensors[1].t_lidar_mag)
    values.insert(D(1), np.concatenate([sensors[1].distortion.C.ravel(), sensors[1].distortion.H]))
    factor = reading_factor(batch, 5, gtsam.noiseModel.Unit.Create(3))
    assert factor.error(values) < 1e-20  # rounding of 40 uT squared


def test_blocks_equal_readings() -> None:
    """Same error, same information, same solution; rounding of 60-row sums allows 1e-9."""
    world, sensors = dipole_world(4), random_sensors(4, 2)
    readings = as_magnetic(drive(4, sensors, world, count=60, noise=0.02))
    rng = np.random.default_rng(4)
    root = rng.normal(size=(len(readings), 3, 3)) + 3 * np.eye(3)
    covariance = root @ root.transpose(0, 2, 1)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    batch = BatchedReadings(world, readings)
    single, stacked = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for n in range(len(batch)):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[n])
        single.add(reading_factor(batch, n, noise))
    for sensor in batch.sensors:
        stacked.add(block_factor(batch, sensor, whitening))
    values = random_values(4, 2)
    assert single.error(values) == pytest.approx(stacked.error(values), rel=1e-9)
    ordering = gtsam.Ordering()
    for i in range(2):
        ordering.push_back(T(i))
        ordering.push_back(D(i))
    H_single, g_single = single.linearize(values).hessian(ordering)
    H_stacked, g_stacked = stacked.linearize(values).hessian(ordering)
    np.testing.assert_allclose(H_single, H_stacked, rtol=1e-9, atol=1e-9 * H_single.max())
    np.testing.assert_allclose(g_single, g_stacked, rtol=1e-9, atol=1e-9 * abs(g_single).max())
    truth = gtsam.Values()
    for i, s in enumerate(sensors):
        truth.insert(T(i), s.t_lidar_mag + 0.05)
        truth.insert(D(i), np.concatenate([np.eye(3).ravel(), np.zeros(3)]))
    for i in range(2):
        a = gtsam.LevenbergMarquardtOptimizer(single, truth).optimize()
        b = gtsam.LevenbergMarquardtOptimizer(stacked, truth).optimize()
        np.testing.assert_allclose(a.atPoint3(T(i)), b.atPoint3(T(i)), atol=1e-7)
        np.testing.assert_allclose(a.atVector(D(i)), b.atVector(D(i)), atol=1e-6)
        assert np.linalg.norm(a.atPoint3(T(i)) - sensors[i].t_lidar_mag) < 0.02


def test_arrays_that_are_written_into_later_change_nothing() -> None:
    world, values = dipole_world(4), random_values(4, 2)
    held = fixed_distortion(values, 2)
    readings = as_magnetic(drive(4, random_sensors(4, 2), world, count=3))
    W = np.tile(np.eye(3), (6, 1, 1))
    factor = block_factor(BatchedReadings(world, readings, held), 1, W)
    again = BatchedReadings(world, readings, held)
    expected = again.residuals(values, 1).residual[again.rows_of(1)].ravel()
    for array in (W, held, readings.sensor, readings.field, readings.p_map_lidar):
        array[:] = 0
    np.testing.assert_array_equal(factor.unwhitenedError(values), expected)


def test_wrong_arguments_are_refused_in_one_line() -> None:
    world = dipole_world(4)
    readings = as_magnetic(drive(4, random_sensors(4, 2), world, count=3))
    motion = PoseMotion(np.ones((6, 6)), np.zeros(1))
    unit, batch = gtsam.noiseModel.Unit.Create, BatchedReadings(world, readings)
    for reading in (-1, 6):
        with pytest.raises(ValueError, match=f"^reading: {reading}; there are 6, from 0$"):
            reading_factor(batch, reading, unit(3))
    with pytest.raises(ValueError, match=r"^noise: of dimension 6; needed is 3$"):
        reading_factor(batch, 0, unit(6))
    with pytest.raises(ValueError, match=r"^sensor: 2 has no reading; of \[0, 1\] there are some$"):
        block_factor(batch, 2, np.ones((6, 3, 3)))
    with pytest.raises(
        ValueError, match=r"^whitening: of shape \(3, 3, 3\); needed is \(6, 3, 3\)$"
    ):
        block_factor(batch, 1, np.ones((3, 3, 3)))
    with pytest.raises(ValueError, match=r"^field: of shape \(1, 3\); needed is \(6, 3\)$"):
        BatchedReadings(world, replace(readings, field=readings.field[:1]))
    with pytest.raises(ValueError, match=r"^PoseMotion.offset: of shape \(1,\); needed is \(6,\)$"):
        BatchedReadings(world, replace(readings, motion=motion))
    with pytest.raises(
        ValueError, match=r"^sensor: 1; there are distortions of 1 sensors, from 0$"
    ):
        BatchedReadings(world, readings, np.ones((1, 12)))


class InterruptedWorld(CountingWorld):
    """A map during whose query another thread asks the same batch for other values."""

    batch: BatchedReadings
    between: list[gtsam.Values]

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self.between:
            self.batch.residuals(self.between.pop(), 0)
        return super().field_and_gradient(points)


def test_two_threads_get_their_own_residuals() -> None:
    one, other, plain = random_values(8, 2), random_values(9, 2), dipole_world(8)
    readings = as_magnetic(drive(8, random_sensors(8, 2), plain, count=4))
    world = InterruptedWorld(plain)
    world.batch, world.between = BatchedReadings(world, readings), [other]
    for values in (one, other, one):
        alone = BatchedReadings(plain, readings).residuals(values, 0).residual
        np.testing.assert_array_equal(world.batch.residuals(values, 0).residual, alone)


def test_a_pose_moves_as_its_twist_says() -> None:
    """Half a second of a quarter turn a second to the left while driving 2 m/s ahead."""
    R = Rotation.from_euler("z", 90, degrees=True).as_matrix()[None]
    twist = np.array([[0, 0, np.pi / 2, 2.0, 0, 0]])
    motion = PoseMotion(twist, np.array([0.25]))
    R_later, p_later = moved(R, np.array([[5.0, 1.0, 0.5]]), motion, np.array([0.75]))
    # Rounding; the lidar looks along y, its line in the map is straight.
    np.testing.assert_allclose(p_later, [[5.0, 2.0, 0.5]], atol=1e-12)
    expected = Rotation.from_euler("z", 135, degrees=True).as_matrix()
    np.testing.assert_allclose(R_later[0], expected, atol=1e-12)
    # Seen from the lidar, which has turned on, that line now points backwards to the right.
    later = motion.after(np.array([0.75])).twist_lidar[0]
    half = np.sqrt(2.0)
    np.testing.assert_allclose(later, [0, 0, np.pi / 2, half, -half, 0], atol=1e-12)


def test_without_motion_time_offsets_are_no_variables() -> None:
    world = dipole_world(1)
    readings = as_magnetic(drive(1, random_sensors(1, 1), world, count=2))
    assert BatchedReadings(world, readings).keys_of(0) == [T(0), D(0)]
    assert BatchedReadings(world, with_motion(readings, 1)).keys_of(0) == [T(0), D(0), S(0)]
