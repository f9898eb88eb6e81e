"""Readings in a field whose weights are variables: derivatives, anchor, agreement with a map."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import (
    ComplexityPenalty,
    KeyPoseReadings,
    M,
    MapBatch,
    N,
    SlowError,
    TileBatch,
    WeightedField,
    X,
    assert_jacobians_match,
    effective_parameters_factor,
    key_pose_factor,
    tile_factor,
)
from tests.support.factor_inputs import (
    calibrations,
    on,
    random_carried,
    step_error,
    whitenings,
    with_motion,
)
from tests.support.tile_inputs import BASIS, TILE, tile_values


def batch_of(readings: KeyPoseReadings, anchor: int, values: gtsam.Values | None) -> TileBatch:
    fixed = None if values is None else calibrations(values)
    return TileBatch(TILE, anchor, BASIS, readings, fixed)


@given(seed=st.integers(0, 10_000), free=st.booleans(), anchor=st.integers(0, 2))
@settings(deadline=None, max_examples=10)
def test_derivatives_by_a_step_are_those_of_finite_differences(
    seed: int, free: bool, anchor: int
) -> None:
    """From the anchor, to it, or neither: what poses have in common adds up."""
    readings, values = random_carried(seed, 2), tile_values(seed, 3)
    batch = batch_of(readings, anchor, None if free else values)
    n = len(batch.rows_of(1))
    factor = tile_factor(batch, 1, whitenings(seed, n), step_error(seed, n, values))
    assert_jacobians_match(factor, values)


@given(seed=st.integers(0, 10_000), free=st.booleans(), timed=st.booleans())
@settings(deadline=None, max_examples=10)
def test_derivatives_are_those_of_finite_differences(seed: int, free: bool, timed: bool) -> None:
    readings, values = random_carried(seed), tile_values(seed)
    readings = with_motion(readings, seed) if timed else readings
    batch = batch_of(readings, 0, None if free else values)
    for k in batch.key_poses:
        factor = tile_factor(batch, k, whitenings(seed, len(batch.rows_of(k))))
        assert_jacobians_match(factor, values)


def test_a_tile_whose_weights_are_known_is_a_map_in_the_frame_of_its_anchor() -> None:
    readings, values = random_carried(1), tile_values(1)
    W = whitenings(1, 4)
    unknown = tile_factor(batch_of(readings, 0, values), 1, W)
    relative = gtsam.Values()
    relative.insert(X(1), values.atPose3(X(0)).between(values.atPose3(X(1))))
    field = WeightedField(BASIS, values.atVector(M(TILE)))
    known = key_pose_factor(MapBatch(field, on(readings, 1), calibrations(values)), 1, W)
    ours, theirs = unknown.unwhitenedError(values), known.unwhitenedError(relative)
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_moving_the_whole_way_changes_nothing() -> None:
    """A loop that closes moves tiles with their anchors: what was seen there stays explained."""
    readings, values = random_carried(2), tile_values(2)
    batch = batch_of(readings, 0, values)
    factors = [tile_factor(batch, k, whitenings(2, 4)) for k in batch.key_poses]
    before = [factor.error(values) for factor in factors]
    shift = gtsam.Pose3.Expmap(np.array([0.3, -0.2, 1.0, 4.0, -7.0, 2.0]))
    for k in range(2):
        values.update(X(k), shift.compose(values.atPose3(X(k))))
    after = [factor.error(values) for factor in factors]
    np.testing.assert_allclose(after, before, rtol=1e-9)


@given(seed=st.integers(0, 10_000), free=st.booleans())
@settings(deadline=None, max_examples=10)
def test_derivatives_of_doubt_are_those_of_finite_differences(seed: int, free: bool) -> None:
    readings, values, rng = random_carried(seed), tile_values(seed), np.random.default_rng(seed)
    batch = batch_of(readings, 0, None if free else values)
    for k in batch.key_poses:
        x = batch.places(values, k).x
        penalty = ComplexityPenalty(x - 0.1, rng.uniform(size=len(x)), rng.normal(size=(len(x), 3)))
        factor = effective_parameters_factor(batch, k, penalty)
        if factor is None:
            assert (k, free) == (0, False)  # at the anchor nothing moves
            continue
        assert_jacobians_match(factor, values)
        linear = penalty.value + 0.1 * penalty.slope.sum(axis=1)
        np.testing.assert_allclose(factor.unwhitenedError(values), linear, atol=1e-12)


def test_at_the_anchor_readings_say_nothing_of_the_pose() -> None:
    batch = batch_of(random_carried(3), 1, tile_values(3))
    assert batch.keys_of(1) == [M(TILE)]
    assert batch.keys_of(0) == [X(0), X(1), M(TILE)]


def test_a_factor_at_the_anchor_does_not_ask_for_its_pose() -> None:
    """A graph may have another key pose of the tile, and no value of the anchor."""
    readings, values = random_carried(3), tile_values(3)
    at_anchor = tile_factor(batch_of(readings, 1, values), 1, whitenings(3, 4))
    expected = at_anchor.error(values)
    values.erase(X(1))
    again = tile_factor(batch_of(readings, 1, values), 1, whitenings(3, 4))
    assert again.error(values) == expected


def test_arrays_that_are_written_into_later_change_no_factor() -> None:
    readings, values = random_carried(3), tile_values(3)
    for k in (0, 1):
        values.insert(N(k), np.ones(3))
    batch, W = batch_of(readings, 1, None), whitenings(3, 4)
    slow = SlowError(0, np.ones((4, 2)))
    penalty = ComplexityPenalty(np.ones((4, 3)), np.ones(4), np.ones((4, 3)))
    factors = [tile_factor(batch, 0, W, slow=slow), effective_parameters_factor(batch, 0, penalty)]
    before = [factor.error(values) for factor in factors if factor is not None]
    for array in (W.own, W.common, slow.shares, penalty.at, penalty.value, penalty.slope):
        array[:] = 0
    assert [factor.error(values) for factor in factors if factor is not None] == before


def test_wrong_arguments_are_refused_in_one_line() -> None:
    batch, W = batch_of(random_carried(3), 1, tile_values(3)), whitenings(3, 4)
    with pytest.raises(ValueError, match=r"^SlowError.shares: of shape \(1, 2\); needed is"):
        tile_factor(batch, 0, W, slow=SlowError(0, np.ones((1, 2))))
    with pytest.raises(ValueError, match=r"^key_pose: 2 has no readings; see key_poses of"):
        tile_factor(batch, 2, W)
    penalty = ComplexityPenalty(np.ones((4, 3)), np.ones(1), np.ones((4, 3)))
    with pytest.raises(ValueError, match=r"^ComplexityPenalty.value: of shape \(1,\); needed is"):
        effective_parameters_factor(batch, 0, penalty)


def test_a_batch_is_evaluated_again_only_when_its_variables_change() -> None:
    readings, values = random_carried(4), tile_values(4)
    batch = batch_of(readings, 0, values)
    seen = batch.residuals(values, 1)
    assert batch.residuals(values, 0) is seen
    values.update(M(TILE), values.atVector(M(TILE)) + 0.1)
    assert batch.residuals(values, 1) is not seen
    assert batch.residuals(values, 1).reading.residual != pytest.approx(seen.reading.residual)
