"""Steps of an odometry along fixed axes: derivatives, and what a wrong heading does to them."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_factors import X, assert_jacobians_match, fixed_axes_step_factor

NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))


def poses(seed: int) -> tuple[gtsam.Pose3, gtsam.Pose3]:
    rng = np.random.default_rng(seed)
    first = gtsam.Pose3.Expmap(rng.normal(size=6))
    return first, first.retract(rng.normal(0, 0.6, 6))


@given(seed=st.integers(0, 10_000))
def test_derivatives_are_those_of_finite_differences(seed: int) -> None:
    rng, values = np.random.default_rng(seed), gtsam.Values()
    for k, pose in enumerate(poses(seed)):
        values.insert(X(k), pose)
    turn = gtsam.Rot3.Expmap(rng.normal(0, 0.5, 3))
    factor = fixed_axes_step_factor(0, turn, rng.normal(size=3), NOISE)
    assert_jacobians_match(factor, values)


@given(seed=st.integers(0, 10_000))
def test_an_error_of_the_attitude_turns_no_step(seed: int) -> None:
    """The axes of both poses off by the same: nothing is left, up to rounding."""
    values, (first, second) = gtsam.Values(), poses(seed)
    way = second.translation() - first.translation()
    turn = second.rotation().compose(first.rotation().inverse())
    wrong = gtsam.Rot3.Expmap(np.random.default_rng(seed).normal(0, 0.3, 3))
    for k, pose in enumerate((first, second)):
        values.insert(X(k), gtsam.Pose3(pose.rotation().compose(wrong), pose.translation()))
    factor = fixed_axes_step_factor(0, turn, way, NOISE)
    np.testing.assert_allclose(factor.unwhitenedError(values), 0.0, atol=1e-9)


def test_the_way_is_kept_and_wrong_arguments_are_refused() -> None:
    way, turn, values = np.ones(3), gtsam.Rot3(), gtsam.Values()
    for k, pose in enumerate(poses(3)):
        values.insert(X(k), pose)
    factor = fixed_axes_step_factor(0, turn, way, NOISE)
    before = factor.error(values)
    way[:] = 0
    assert factor.error(values) == before
    with pytest.raises(ValueError, match=r"^way: of shape \(2,\); needed is \(3,\)$"):
        fixed_axes_step_factor(0, turn, np.ones(2), NOISE)
    with pytest.raises(ValueError, match=r"^noise: of dimension 3; needed is 6$"):
        fixed_axes_step_factor(0, turn, way, gtsam.noiseModel.Unit.Create(3))
