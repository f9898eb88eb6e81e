"""Readings of a tile on several key poses as one factor, against a factor for each."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import (
    ComplexityPenalty,
    KeyPoseReadings,
    M,
    N,
    ReadingErrors,
    Residual,
    S,
    SlowError,
    StepError,
    TileBatch,
    TileBlocks,
    Whitening,
    X,
    assert_jacobians_match,
    effective_parameters,
    joint_residual,
    tile_block,
    tile_residual,
)
from l2m_gtsam.data import FloatArray
from tests.support.factor_inputs import calibrations, random_carried, with_motion
from tests.support.tile_inputs import BASIS, TILE, tile_values

SIZES = {"X": 6, "M": len(BASIS), "T": 3, "D": 12, "S": 1, "N": 3}
ROUNDING = 1e-10  # of uT and uT/m, up to a few hundred


def random_whitening(seed: int, count: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.eye(3) + 0.3 * np.tril(rng.normal(size=(count, 3, 3)))


def blocks_of(
    readings: KeyPoseReadings, anchor: int, W: FloatArray, values: gtsam.Values | None
) -> TileBlocks:
    fixed = None if values is None else calibrations(values)
    return TileBlocks(TILE, anchor, BASIS, readings, W, fixed)


def assert_alike(ours: FloatArray, theirs: FloatArray) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=ROUNDING, atol=ROUNDING)


def derivatives(residual: Residual, values: gtsam.Values) -> dict[int, FloatArray]:
    blocks = [np.empty((0, 0))] * len(residual.keys)
    residual.error(values, blocks)
    return dict(zip(residual.keys, blocks, strict=True))


@given(
    seed=st.integers(0, 10_000),
    free=st.booleans(),
    timed=st.booleans(),
    anchor=st.integers(0, 2),
    chosen=st.sets(st.integers(0, 1), min_size=1),
)
@settings(deadline=None, max_examples=25)
def test_a_block_is_its_key_poses_together(
    seed: int, free: bool, timed: bool, anchor: int, chosen: set[int]
) -> None:
    readings, values, key_poses = random_carried(seed), tile_values(seed, 3), sorted(chosen)
    readings = with_motion(readings, seed) if timed else readings
    W, fixed = random_whitening(seed, len(readings)), None if free else calibrations(values)
    batch = TileBatch(TILE, anchor, BASIS, readings, fixed)
    white = {k: Whitening.independent(W[batch.rows_of(k)]) for k in key_poses}
    theirs = joint_residual([tile_residual(batch, k, white[k]) for k in key_poses])
    blocks = blocks_of(readings, anchor, W, None if free else values)
    ours = joint_residual(list(blocks.white_residuals(key_poses)))
    assert_alike(ours.error(values, None), theirs.error(values, None))
    own, other = derivatives(ours, values), derivatives(theirs, values)
    assert own.keys() == other.keys()
    for key, block in own.items():
        assert_alike(block, other[key])


def random_errors(seed: int, key_pose: int, count: int, slow: bool) -> ReadingErrors:
    """Return what so many readings share: two errors, a step that is off, and perhaps a slow one.

    Common errors are a whitening's: ``I - B B^T`` has no direction that it turns round.
    """
    rng = np.random.default_rng([seed, key_pose])
    common = np.linalg.qr(rng.normal(size=(3 * count, 2)))[0] * rng.uniform(0.1, 0.9, 2)
    step = StepError(
        key_pose, gtsam.Pose3.Expmap(rng.normal(0, 0.3, 6)), rng.normal(0, 20, (count, 3, 6))
    )
    return ReadingErrors(
        common, step, SlowError(key_pose, rng.normal(size=(count, 2))) if slow else None
    )


def with_slow_errors(values: gtsam.Values, seed: int) -> gtsam.Values:
    rng = np.random.default_rng(seed)
    for k in range(3):
        values.insert(N(k), rng.normal(size=3))
    return values


@given(
    seed=st.integers(0, 10_000),
    free=st.booleans(),
    slow=st.sets(st.integers(0, 1)),
    anchor=st.integers(0, 2),
    chosen=st.sets(st.integers(0, 1), min_size=1),
)
@settings(deadline=None, max_examples=25)
def test_a_block_with_shared_errors_is_its_key_poses_together(
    seed: int, free: bool, slow: set[int], anchor: int, chosen: set[int]
) -> None:
    readings, values, key_poses = random_carried(seed), tile_values(seed, 3), sorted(chosen)
    values = with_slow_errors(values, seed)
    W, fixed = random_whitening(seed, len(readings)), None if free else calibrations(values)
    batch = TileBatch(TILE, anchor, BASIS, readings, fixed)
    errors = {k: random_errors(seed, k, len(batch.rows_of(k)), k in slow) for k in key_poses}
    theirs = joint_residual(
        [
            tile_residual(batch, k, Whitening(W[batch.rows_of(k)], own.common), own.step, own.slow)
            for k, own in errors.items()
        ]
    )
    blocks = blocks_of(readings, anchor, W, None if free else values)
    ours = blocks.residual_with_errors(key_poses, list(errors.values()))
    assert_alike(ours.error(values, None), theirs.error(values, None))
    own, other = derivatives(ours, values), derivatives(theirs, values)
    assert own.keys() == other.keys()
    for key, block in own.items():
        assert_alike(block, other[key])


def test_derivatives_with_shared_errors_are_those_of_finite_differences() -> None:
    readings, values = random_carried(6), with_slow_errors(tile_values(6, 3), 6)
    blocks = blocks_of(readings, 0, random_whitening(6, len(readings)), None)
    errors = [random_errors(6, k, len(blocks.rows_of(k)), True) for k in blocks.key_poses]
    assert_jacobians_match(blocks.residual_with_errors(blocks.key_poses, errors).factor(), values)


def test_shared_errors_are_kept_and_wrong_ones_refused() -> None:
    readings, values = random_carried(7), with_slow_errors(tile_values(7, 3), 7)
    blocks = blocks_of(readings, 2, random_whitening(7, len(readings)), values)
    count = len(blocks.rows_of(0))
    own = random_errors(7, 0, count, True)
    residual = blocks.residual_with_errors([0], [own])
    before = residual.error(values, None)
    assert own.slow is not None
    for array in (own.common, own.step.slope, own.slow.shares):
        array[:] = 0
    np.testing.assert_array_equal(residual.error(values, None), before)
    short = random_errors(7, 0, count - 1, True)
    with pytest.raises(ValueError, match=r"^ReadingErrors.common: of shape"):
        blocks.residual_with_errors([0], [short])
    with pytest.raises(ValueError, match=r"^StepError.slope: of shape"):
        blocks.residual_with_errors([0], [ReadingErrors(own.common, short.step)])
    with pytest.raises(ValueError, match=r"^key_pose: 7 has no readings; see key_poses of"):
        blocks.residual_with_errors([7], [own])


@given(
    seed=st.integers(0, 10_000), free=st.booleans(), timed=st.booleans(), anchor=st.integers(0, 2)
)
@settings(deadline=None, max_examples=15)
def test_penalties_of_a_block_are_those_of_its_key_poses(
    seed: int, free: bool, timed: bool, anchor: int
) -> None:
    readings, values = random_carried(seed), tile_values(seed, 3)
    readings = with_motion(readings, seed) if timed else readings
    fixed, rng = None if free else calibrations(values), np.random.default_rng(seed)
    batch, count = TileBatch(TILE, anchor, BASIS, readings, fixed), len(readings)
    penalty = ComplexityPenalty(
        rng.normal(size=(count, 3)), rng.uniform(size=count), rng.normal(size=(count, 3))
    )
    each = [effective_parameters(batch, k, penalty[batch.rows_of(k)]) for k in batch.key_poses]
    blocks = blocks_of(readings, anchor, random_whitening(seed, count), None if free else values)
    ours = blocks.penalty(batch.key_poses, penalty)
    assert ours is not None
    own = ours.factor()
    assert_jacobians_match(own, values)
    on_anchor = [k for k, one in zip(batch.key_poses, each, strict=True) if one is None]
    theirs = joint_residual([one for one in each if one is not None]).factor()
    error = own.unwhitenedError(values)
    moving_rows = [k not in on_anchor for k in batch.key_poses for _ in batch.rows_of(k)]
    assert_alike(error[moving_rows], theirs.unwhitenedError(values))


def test_derivatives_are_those_of_finite_differences() -> None:
    readings, values = random_carried(6), tile_values(6, 3)
    blocks = blocks_of(readings, 0, random_whitening(6, len(readings)), None)
    for residual in blocks.white_residuals(blocks.key_poses):
        assert_jacobians_match(residual.factor(), values)


def test_it_is_evaluated_again_whatever_changes() -> None:
    readings, values = with_motion(random_carried(4), 4), with_slow_errors(tile_values(4, 3), 4)
    blocks, count = blocks_of(readings, 2, random_whitening(4, len(readings)), None), len(readings)
    rng = np.random.default_rng(4)
    every = ComplexityPenalty(
        rng.normal(size=(count, 3)), rng.uniform(size=count), rng.normal(size=(count, 3))
    )
    errors = [random_errors(4, k, len(blocks.rows_of(k)), True) for k in blocks.key_poses]
    penalty = blocks.penalty(blocks.key_poses, every)
    whole = joint_residual(list(blocks.white_residuals(blocks.key_poses)))
    with_errors = blocks.residual_with_errors(blocks.key_poses, errors)
    assert penalty is not None
    # Places depend on time offsets, by which a penalty has no derivative.
    for residual, keys in (
        (whole, whole.keys),
        (with_errors, with_errors.keys),
        (penalty, [*penalty.keys, S(0)]),
    ):
        for key in keys:
            before = residual.error(values, None)
            moved = gtsam.VectorValues()
            moved.insert(key, np.full(SIZES[chr(gtsam.symbolChr(key))], 0.01))
            values = values.retract(moved)
            assert residual.error(values, None) != pytest.approx(before, abs=1e-9)


def test_a_factor_may_be_asked_with_its_own_values_alone() -> None:
    """As GTSAM asks a graph of one factor; then with all values again."""
    readings, values = random_carried(4), tile_values(4, 3)
    blocks = blocks_of(readings, 2, random_whitening(4, len(readings)), None)
    for key_pose in blocks.key_poses:
        for residual in blocks.white_residuals([key_pose]):
            whole = residual.error(values, None)
            alone = residual.error(values.extract(residual.keys), None)
            np.testing.assert_array_equal(alone, whole)
            np.testing.assert_array_equal(residual.error(values, None), whole)


def test_of_the_anchor_alone_there_is_no_pose_and_no_penalty() -> None:
    readings, values = random_carried(3), tile_values(3)
    blocks = blocks_of(readings, 1, random_whitening(3, len(readings)), values)
    assert [each.keys for each in blocks.white_residuals([1])] == [[M(TILE)]]
    assert [each.keys for each in blocks.white_residuals([0, 1])] == [[X(0), X(1), M(TILE)]]
    nothing = np.zeros((len(readings), 3))
    assert blocks.penalty([1], ComplexityPenalty(nothing, nothing[:, 0], nothing)) is None


def test_few_sensors_to_a_factor_are_all_of_them_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same cost, and the same gradient."""
    readings, values = random_carried(5), tile_values(5, 3)
    blocks = blocks_of(readings, 2, random_whitening(5, len(readings)), None)
    whole = joint_residual(list(blocks.white_residuals(blocks.key_poses)))
    monkeypatch.setattr(tile_block, "SENSORS", 1)
    parts = list(blocks.white_residuals(blocks.key_poses))
    assert len(parts) == 2
    assert all(set(each.keys) < set(whole.keys) for each in parts)
    of_parts = joint_residual(parts)
    for key in whole.keys:
        ours, theirs = (
            derivatives(each, values)[key].T @ each.error(values, None)
            for each in (of_parts, whole)
        )
        assert_alike(ours, theirs)
    squares = [float(np.sum(each.error(values, None) ** 2)) for each in (of_parts, whole)]
    assert squares[0] == pytest.approx(squares[1], rel=ROUNDING)


def test_a_factor_needs_no_values_but_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    readings, values = random_carried(7), tile_values(7, 3)
    monkeypatch.setattr(tile_block, "SENSORS", 1)
    W = random_whitening(7, len(readings))
    for residual in blocks_of(readings, 2, W, None).white_residuals([0]):
        own, alone = gtsam.Values(), list(blocks_of(readings, 2, W, None).white_residuals([0]))
        for key in residual.keys:
            own.insert(values.extract([key]))
        same = next(each for each in alone if each.keys == residual.keys)
        assert_alike(same.error(own, None), residual.error(values, None))


def test_a_whitening_is_kept_and_a_wrong_one_refused() -> None:
    readings, values = random_carried(7), tile_values(7, 3)
    W = random_whitening(7, len(readings))
    (one,) = blocks_of(readings, 2, W, values).white_residuals([0])
    (other,) = blocks_of(readings, 2, W.copy(), values).white_residuals([0])
    W[:] = 0
    np.testing.assert_array_equal(one.error(values, None), other.error(values, None))
    with pytest.raises(ValueError, match=r"^whitening: of shape \(1, 3, 3\); needed is"):
        blocks_of(readings, 2, W[:1], values)
