"""Readings over an uncertain map: derivatives, and the certain map as a special case."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import (
    BatchedReadings,
    M,
    MagneticReadings,
    assert_jacobians_match,
    block_factor,
    map_weights_prior,
    uncertain_block_factor,
)
from l2m_gtsam.data import FloatArray
from tests.factors.test_reading import as_magnetic, random_values, with_motion
from tests.worlds import DipoleWorld, dipole_world, drive, random_sensors

TILES = {7: 4, 2: 6}  # weights of each; keys are no positions


def with_weights(seed: int, sensors: int) -> gtsam.Values:
    values, rng = random_values(seed, sensors), np.random.default_rng(seed + 1)
    for tile, size in TILES.items():
        values.insert(M(tile), rng.normal(size=size))
    return values


def some_readings(seed: int, world: DipoleWorld, count: int = 5) -> MagneticReadings:
    return as_magnetic(drive(seed, random_sensors(seed, 2), world, count=count, tilt=0.5))


def features(seed: int, count: int, size: int) -> FloatArray:
    return np.random.default_rng(seed + 2).normal(size=(count, 3, size))


def whitenings(seed: int, count: int) -> FloatArray:
    return np.random.default_rng(seed + 3).normal(size=(count, 3, 3)) + 3 * np.eye(3)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), tile=st.sampled_from(sorted(TILES)))
def test_jacobians_match_central_differences(seed: int, tile: int) -> None:
    """Random poses, t, C, H, weights and features, any rows; 1e-6 as for all factors."""
    batch = BatchedReadings(world := dipole_world(seed), some_readings(seed, world))
    rows = np.array([6, 9, 8])  # of the second sensor
    A, W = features(seed, 3, TILES[tile]), whitenings(seed, 3)
    timed = BatchedReadings(world, with_motion(some_readings(seed, world), seed))
    for each in (batch, timed):
        factor = uncertain_block_factor(each, rows, tile, A, W)
        assert_jacobians_match(factor, with_weights(seed, 2), rtol=1e-6, step=2e-5)


def test_the_error_is_that_of_the_map_plus_its_error() -> None:
    """e = C R^T (B + A beta) + H - z, whitened, reading by reading."""
    world = dipole_world(1)
    readings, values = some_readings(1, world), with_weights(1, 2)
    rows, A, W = np.array([2, 0]), features(1, 2, 6), whitenings(1, 2)
    factor = uncertain_block_factor(BatchedReadings(world, readings), rows, 2, A, W)
    _, b = factor.linearize(values).jacobian()
    C, H = (part := values.atVector(gtsam.symbol("D", 0)))[:9].reshape(3, 3), part[9:]
    t, beta = values.atPoint3(gtsam.symbol("T", 0)), values.atVector(M(2))
    expected = []
    for k, row in enumerate(rows):
        R, p = readings.R_map_lidar[row], readings.p_map_lidar[row]
        field = world.field_and_gradient((R @ t + p)[None])[0][0] + A[k] @ beta
        expected.append(W[k] @ (C @ R.T @ field + H - readings.field[row]))
    # Sums of some 100 uT in another order.
    np.testing.assert_allclose(-b, np.concatenate(expected), rtol=0, atol=1e-10)


def test_without_an_error_the_map_is_certain() -> None:
    """Weights of zero: the same error, and the same derivatives by T and D."""
    world = dipole_world(2)
    batch, values = BatchedReadings(world, some_readings(2, world)), with_weights(2, 2)
    values.update(M(7), np.zeros(4))
    W, rows = whitenings(2, 10), np.arange(5, 10)
    ours = uncertain_block_factor(batch, rows, 7, features(2, 5, 4), W[rows])
    plain = block_factor(batch, 1, W)
    assert ours.error(values) == pytest.approx(plain.error(values), rel=1e-12)
    A, b = ours.linearize(values).jacobian()
    A_plain, b_plain = plain.linearize(values).jacobian()
    np.testing.assert_allclose(A[:, :15], A_plain, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(b, b_plain, rtol=1e-12, atol=1e-12)


def test_weights_are_shared_by_the_sensors_of_a_tile() -> None:
    """Factors of two sensors in one tile meet in one variable."""
    world = dipole_world(3)
    batch, A, W = (
        BatchedReadings(world, some_readings(3, world)),
        features(3, 3, 6),
        whitenings(3, 3),
    )
    first, second = (
        uncertain_block_factor(batch, np.arange(start, start + 3), 2, A, W) for start in (0, 5)
    )
    assert set(first.keys()) & set(second.keys()) == {M(2)}


@settings(max_examples=10)
@given(seed=st.integers(0, 1000))
def test_the_prior_is_that_of_the_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(10, 10)) + 5 * np.eye(10)
    covariance = root @ root.T
    information_root = np.linalg.inv(np.linalg.cholesky(covariance))
    values = with_weights(seed, 0)
    factor = map_weights_prior(TILES, information_root)
    beta = np.concatenate([values.atVector(M(tile)) for tile in TILES])
    expected = 0.5 * beta @ np.linalg.solve(covariance, beta)
    assert factor.error(values) == pytest.approx(expected, rel=1e-9)
    assert_jacobians_match(factor, values)
