"""Readings that share errors of map and poses: derivatives, and none as a special case."""

import re
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from l2m_factors import (
    BatchedReadings,
    M,
    MagneticReadings,
    P,
    ReadingResiduals,
    SharedError,
    UncertainReadings,
    assert_jacobians_match,
    block_factor,
    map_weights_information,
    map_weights_prior,
    pose_errors_prior,
    uncertain_block_factor,
    uncertain_reading_factor,
)
from l2m_gtsam.data import FloatArray, IntArray
from tests.support.factor_inputs import as_magnetic, random_values, with_motion
from tests.worlds.exact import DipoleWorld, dipole_world, drive, random_sensors

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


def block_of(
    batch: BatchedReadings, rows: IntArray, errors: list[SharedError], W: FloatArray
) -> gtsam.CustomFactor:
    return uncertain_block_factor(UncertainReadings(batch, rows, errors, W))


def in_tile(tile: int, A: FloatArray) -> list[SharedError]:
    return [SharedError(M(tile), A)]


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), tile=st.sampled_from(sorted(TILES)))
def test_jacobians_match_central_differences(seed: int, tile: int) -> None:
    """Random poses, t, C, H, weights and features, any rows; 1e-6 as for all factors."""
    batch = BatchedReadings(world := dipole_world(seed), some_readings(seed, world))
    rows = np.array([6, 9, 8])  # of the second sensor
    A, W = features(seed, 3, TILES[tile]), whitenings(seed, 3)
    timed = BatchedReadings(world, with_motion(some_readings(seed, world), seed))
    values, errors = with_weights(seed, 2), in_tile(tile, A)
    values.insert(P(3), np.random.default_rng(seed).normal(size=6))
    poses = [*errors, SharedError(P(3), features(seed + 9, 3, 6))]
    dense = np.random.default_rng(seed).normal(size=(9, 9)) + 3 * np.eye(9)
    for factor in (
        block_of(batch, rows, errors, W),
        block_of(timed, rows, errors, W),
        block_of(timed, rows, poses, dense),
    ):
        # Beside a dipole e is so long that its last digit, over the step, is more than 1e-6.
        assume(factor.error(values) < 1e9)
        assert_jacobians_match(factor, values, rtol=1e-6, step=2e-5)


def test_the_error_is_that_of_the_map_plus_its_error() -> None:
    """e = C (R^T B + F gamma) + H - z, whitened, reading by reading."""
    world = dipole_world(1)
    readings, values = some_readings(1, world), with_weights(1, 2)
    rows, A, W = np.array([2, 0]), features(1, 2, 6), whitenings(1, 2)
    factor = block_of(BatchedReadings(world, readings), rows, in_tile(2, A), W)
    _, b = factor.linearize(values).jacobian()
    C, H = (part := values.atVector(gtsam.symbol("D", 0)))[:9].reshape(3, 3), part[9:]
    t, beta = values.atPoint3(gtsam.symbol("T", 0)), values.atVector(M(2))
    expected = []
    for k, row in enumerate(rows):
        R, p = readings.R_map_lidar[row], readings.p_map_lidar[row]
        field = R.T @ world.field_and_gradient((R @ t + p)[None])[0][0] + A[k] @ beta
        expected.append(W[k] @ (C @ field + H - readings.field[row]))
    # Sums of some 100 uT in another order.
    np.testing.assert_allclose(-b, np.concatenate(expected), rtol=0, atol=1e-10)


def test_without_an_error_the_map_is_certain() -> None:
    """Weights of zero: the same error, and the same derivatives by T and D, in either whitening."""
    world = dipole_world(2)
    batch, values = BatchedReadings(world, some_readings(2, world)), with_weights(2, 2)
    values.update(M(7), np.zeros(4))
    W, rows = whitenings(2, 10), np.arange(5, 10)
    ours = block_of(batch, rows, in_tile(7, features(2, 5, 4)), W[rows])
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
        block_of(batch, np.arange(start, start + 3), in_tile(2, A), W) for start in (0, 5)
    )
    assert set(first.keys()) & set(second.keys()) == {M(2)}


def test_one_matrix_for_all_readings_is_as_good_as_one_for_each() -> None:
    world = dipole_world(2)
    batch, values = BatchedReadings(world, some_readings(2, world)), with_weights(2, 2)
    W, rows, errors = whitenings(2, 3), np.arange(5, 8), in_tile(7, features(2, 3, 4))
    each = block_of(batch, rows, errors, W).linearize(values)
    whole = block_of(batch, rows, errors, block_diag(*W)).linearize(values)
    for one, other in zip(each.jacobian(), whole.jacobian(), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dense", [False, True], ids=["each", "together"])
def test_a_factor_for_each_reading_is_as_good_as_one_for_all(dense: bool) -> None:
    """The same rows in another packing: to the last bit, also after a step and back."""
    world = dipole_world(2)
    batch, values = BatchedReadings(world, some_readings(2, world)), with_weights(2, 2)
    W, rows, errors = whitenings(2, 3), np.arange(5, 8), in_tile(7, features(2, 3, 4))
    if dense:
        common = np.random.default_rng(0).normal(size=(9, 9))
        W = np.linalg.inv(np.linalg.cholesky(block_diag(*W) + common @ common.T + 9 * np.eye(9)))
    readings = UncertainReadings(batch, rows, errors, W)
    each = [uncertain_reading_factor(readings, k) for k in range(3)]
    moved = gtsam.Values(values)
    moved.update(M(7), values.atVector(M(7)) + 1.0)
    for at in (values, moved, values):
        J, b = block_of(batch, rows, errors, W).linearize(at).jacobian()
        parts = [factor.linearize(at).jacobian() for factor in each]
        np.testing.assert_array_equal(np.concatenate([part[0] for part in parts]), J)
        np.testing.assert_array_equal(np.concatenate([part[1] for part in parts]), b)
        assert sum(factor.error(at) for factor in each) == pytest.approx(0.5 * b @ b, rel=1e-12)


@pytest.mark.parametrize(
    ("rows", "errors", "length", "line"),
    [
        ([4, 5], 2, 2, "rows: of sensors [0, 1]; make UncertainReadings of each sensor"),
        ([], 0, 0, "rows: none; at least one reading is needed"),
        ([9, 10], 2, 2, "rows: 10; there are 10, from 0"),
        ([5, 6], None, 2, "errors: none; block_factor is for readings that share none"),
        ([5, 6], 3, 2, "features of M7: of shape (3, 3, 4); needed is (2, 3, 4)"),
        ([5, 6], 2, 3, "whitening: of shape (3, 3, 3); needed is (2, 3, 3)"),
    ],
)
def test_wrong_readings_are_refused_in_one_line(
    rows: list[int], errors: int | None, length: int, line: str
) -> None:
    batch = BatchedReadings(world := dipole_world(2), some_readings(2, world))
    shared = [] if errors is None else in_tile(7, features(2, errors, 4))
    with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
        UncertainReadings(batch, np.array(rows, dtype=np.int64), shared, whitenings(2, length))


def test_distortions_that_are_held_are_refused_in_one_line() -> None:
    world, held = dipole_world(2), np.ones((2, 12))
    batch, errors = BatchedReadings(world, some_readings(2, world), held), features(2, 2, 4)
    with pytest.raises(ValueError, match=r"^batch: its distortions are held; leave them out, with"):
        UncertainReadings(batch, np.array([5, 6]), in_tile(7, errors), whitenings(2, 2))


def test_a_reading_that_is_none_of_them_is_refused() -> None:
    batch = BatchedReadings(world := dipole_world(2), some_readings(2, world))
    rows, errors = np.array([5, 6]), in_tile(7, features(2, 2, 4))
    group = UncertainReadings(batch, rows, errors, whitenings(2, 2))
    rows[:] = 0  # it keeps its own
    values = with_weights(2, 2)
    expected = UncertainReadings(batch, np.array([5, 6]), errors, whitenings(2, 2))
    np.testing.assert_array_equal(group.residual(values), expected.residual(values))
    with pytest.raises(ValueError, match=r"^reading: -1; there are 2, from 0$"):
        uncertain_reading_factor(group, -1)


class Interrupted(BatchedReadings):
    """A batch during whose derivatives another thread asks the readings for other values."""

    group: UncertainReadings
    between: list[gtsam.Values]

    def jacobian(self, residuals: ReadingResiduals) -> FloatArray:
        if self.between:
            self.group.white_residual(self.between.pop())
        return super().jacobian(residuals)


def test_two_threads_get_their_own_rows() -> None:
    one, other, world = with_weights(2, 2), with_weights(3, 2), dipole_world(2)
    rows, errors, W = np.arange(5, 8), in_tile(7, features(2, 3, 4)), whitenings(2, 3)
    batch = Interrupted(world, some_readings(2, world))
    batch.between, batch.group = [other], UncertainReadings(batch, rows, errors, W)
    plain = BatchedReadings(world, some_readings(2, world))
    for values in (one, other, one):
        alone = UncertainReadings(plain, rows, errors, W).linearised(values)
        found = batch.group.linearised(values)
        np.testing.assert_array_equal(found.residual, alone.residual)
        np.testing.assert_array_equal(found.jacobian, alone.jacobian)


def test_a_reading_adds_to_those_before_it_only() -> None:
    """Its factor, white together with others, does not change with a reading after it."""
    world = dipole_world(2)
    W = np.linalg.inv(np.linalg.cholesky(np.eye(9) + np.ones((9, 9))))
    errors, values = in_tile(7, features(2, 3, 4)), with_weights(2, 2)
    found = []
    for shift in (0.0, 5.0):
        readings = some_readings(2, world)
        field = readings.field.copy()
        field[7] += shift
        batch = BatchedReadings(world, replace(readings, field=field))
        group = UncertainReadings(batch, np.arange(5, 8), errors, W)
        found.append([uncertain_reading_factor(group, k).error(values) for k in range(3)])
    assert found[0][:2] == found[1][:2]
    assert found[0][2] != found[1][2]


def test_the_prior_of_pose_errors_is_a_chain_of_unit_variance() -> None:
    """Covariance of knots i and k: the product of the correlations between them; rounding."""
    likes, graph, values = (0.5, 0.9), pose_errors_prior((0.5, 0.9)), gtsam.Values()
    for knot in range(3):
        values.insert(P(knot), np.random.default_rng(knot).normal(size=6))
    for index in range(graph.size()):
        assert_jacobians_match(graph.at(index), values)
    marginals = gtsam.Marginals(graph, values)
    joint = marginals.jointMarginalCovariance([P(0), P(1), P(2)])
    for i, k, like in ((0, 0, 1), (1, 1, 1), (2, 2, 1), (0, 1, 0.5), (1, 2, 0.9), (0, 2, 0.45)):
        np.testing.assert_allclose(joint.at(P(i), P(k)), like * np.eye(6), atol=1e-12)
    assert graph.size() == len(likes) + 1


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


def test_the_prior_as_information_is_the_same() -> None:
    """Error, and information with its gradient, of many tiles, from a triangle; rounding."""
    rng = np.random.default_rng(4)
    sizes = {tile: 1 + tile % 3 for tile in range(11)}
    count = sum(sizes.values())
    root = np.tril(rng.normal(size=(count, count))) + 4 * np.eye(count)
    values = gtsam.Values()
    for tile, size in sizes.items():
        values.insert(M(tile), rng.normal(size=size))
    rows = map_weights_prior(sizes, root)
    squared = map_weights_information(sizes, np.tril(root.T @ root))
    assert squared.error(values) == pytest.approx(rows.error(values), rel=1e-12)
    graphs = []
    for factor in (rows, squared):
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(factor.linearize(values))
        graphs.append(graph)
    (H, eta), (other_H, other_eta) = (graph.hessian() for graph in graphs)
    np.testing.assert_allclose(other_H, H, rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(other_eta, eta, rtol=1e-11, atol=1e-10)
