"""Steps of an odometry whose scale is a variable: derivatives, and what they come to."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import G, X, assert_jacobians_match, scaled_step_factor
from tests.support.factor_inputs import drawn_step

NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))


def values_of(seed: int, longer: float) -> tuple[gtsam.Pose3, gtsam.Values]:
    """Return a step, and two key poses that are about so far apart."""
    step, values = drawn_step(np.random.default_rng(seed))
    values.insert(G(), longer)
    return step, values


@given(seed=st.integers(0, 10_000), longer=st.floats(-0.3, 0.3))
@settings(deadline=None, max_examples=30)
def test_derivatives_are_those_of_finite_differences(seed: int, longer: float) -> None:
    step, values = values_of(seed, longer)
    assert_jacobians_match(scaled_step_factor(4, step, NOISE), values)


@given(seed=st.integers(0, 10_000), longer=st.floats(-0.3, 0.3))
@settings(deadline=None, max_examples=30)
def test_a_known_scale_makes_it_a_step_that_is_longer(seed: int, longer: float) -> None:
    """GTSAM's own factor with the way as it is then; rounding of a logarithm is less than 1e-9."""
    step, values = values_of(seed, longer)
    longer_step = gtsam.Pose3(step.rotation(), (1 + longer) * step.translation())
    plain = gtsam.BetweenFactorPose3(X(4), X(5), longer_step, NOISE)
    ours = scaled_step_factor(4, step, NOISE)
    np.testing.assert_allclose(
        ours.unwhitenedError(values), plain.unwhitenedError(values), atol=1e-9
    )
    assert np.isclose(ours.error(values), plain.error(values), rtol=1e-9, atol=1e-9)


def test_noise_of_another_dimension_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^noise: of dimension 3; needed is 6$"):
        scaled_step_factor(4, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(3))
