"""Steps of an odometry that drifts steadily: derivatives, and what they come to."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import (
    V,
    X,
    assert_jacobians_match,
    drift_weights,
    drifting_fixed_axes_step,
    drifting_step,
    fixed_axes_step_factor,
)
from l2m_factors.field_map import FloatArray
from tests.support.factor_inputs import drawn_step

NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))


def drawn(seed: int) -> tuple[gtsam.Pose3, FloatArray, gtsam.Values]:
    """Return a step, weights of a drift, and two key poses that are about so far apart."""
    rng = np.random.default_rng(seed)
    step, values = drawn_step(rng)
    shape = [(2,), (2, 3), (6, 8)][seed % 3]  # along all axes alike, along each, and turning
    weights = rng.uniform(0.0, 0.3, shape)
    if len(weights) == 6:
        weights[:3] = np.outer(rng.normal(size=3), rng.uniform(0.0, 0.3, 8))
    values.insert(V(), rng.normal(size=drift_weights(weights).shape[1]))
    return step, weights, values


@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=30)
def test_derivatives_are_those_of_finite_differences(seed: int) -> None:
    step, weights, values = drawn(seed)
    assert_jacobians_match(drifting_step(4, step, weights).factor(NOISE), values)
    way = step.translation()
    assert_jacobians_match(
        drifting_fixed_axes_step(4, step.rotation(), way, weights).factor(NOISE), values
    )


@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=30)
def test_a_step_without_its_drift_is_the_plain_one(seed: int) -> None:
    """GTSAM's own factor and that of fixed axes; rounding of a logarithm is less than 1e-9."""
    step, weights, values = drawn(seed)
    turn, added = np.split(drift_weights(weights) @ values.atVector(V()), 2)
    axes = values.atPose3(X(4)).rotation()
    back = gtsam.Rot3.Expmap(-axes.unrotate(turn))
    still = gtsam.Pose3(back.compose(step.rotation()), step.translation() - axes.unrotate(added))
    plain = gtsam.BetweenFactorPose3(X(4), X(5), still, NOISE)
    ours = drifting_step(4, step, weights).factor(NOISE)
    np.testing.assert_allclose(
        ours.unwhitenedError(values), plain.unwhitenedError(values), atol=1e-9
    )
    way, turned = step.translation(), gtsam.Rot3.Expmap(-turn).compose(step.rotation())
    fixed = fixed_axes_step_factor(4, turned, way - added, NOISE)
    drifting = drifting_fixed_axes_step(4, step.rotation(), way, weights).factor(NOISE)
    np.testing.assert_allclose(
        drifting.unwhitenedError(values), fixed.unwhitenedError(values), atol=1e-12
    )


def test_the_way_is_kept_and_wrong_arguments_are_refused() -> None:
    rng, turn, way, weights = np.random.default_rng(3), gtsam.Rot3(), np.ones(3), np.ones(2)
    _, values = drawn_step(rng)
    values.insert(V(), np.ones(6))
    step = drifting_fixed_axes_step(4, turn, way, weights)
    before = step.error(values, None)
    way[:] = 0
    np.testing.assert_array_equal(step.error(values, None), before)
    with pytest.raises(ValueError, match=r"^way: of shape \(2,\); needed is \(3,\)$"):
        drifting_fixed_axes_step(4, turn, np.ones(2), weights)
    with pytest.raises(ValueError, match=r"^noise: of dimension 3; needed is 6$"):
        step.factor(gtsam.noiseModel.Unit.Create(3))
