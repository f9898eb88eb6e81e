import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from l2m_gtsam.maps.posterior import kernel_matrix, scaled

# The exponent is a difference of squares of up to 30 length scales, whose digits end at 1e-13.
ROUNDING = 1e-12


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), signal=st.floats(0.01, 100), spread=st.floats(0.1, 5))
def test_the_matrix_is_the_formula(seed: int, signal: float, spread: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0, spread, (30, 3)), rng.normal(0, spread, (50, 3))
    expected = signal**2 * np.exp(-0.5 * cdist(x, y, "sqeuclidean"))
    np.testing.assert_allclose(
        kernel_matrix(x, y, signal), expected, rtol=0, atol=ROUNDING * signal**2
    )


def test_a_matrix_of_points_with_themselves_is_a_covariance() -> None:
    y = np.random.default_rng(0).normal(0, 2, (60, 3))
    K = kernel_matrix(y, y, 3.0)
    np.testing.assert_allclose(K, K.T, rtol=0, atol=ROUNDING * 9)
    np.testing.assert_allclose(np.diag(K), 9.0, rtol=ROUNDING)
    assert np.linalg.eigvalsh(K).min() > -60 * ROUNDING * 9  # zero but for rounding


@pytest.mark.parametrize("distance", [1e3, 1e9, 1e200, 1e308])
def test_far_away_the_kernel_is_zero_and_never_nan(distance: float) -> None:
    y = np.random.default_rng(1).normal(0, 1, (20, 3))
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        x = scaled(distance * direction[None], np.zeros(3), 0.5)
        np.testing.assert_array_equal(kernel_matrix(x, y, 2.0), 0.0)
