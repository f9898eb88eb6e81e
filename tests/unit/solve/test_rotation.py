"""The rotation convention and its delta method."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.geometry import polar_rotation


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000))
def test_it_is_the_polar_factor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    C = Rotation.random(rng=rng).as_matrix() @ (np.eye(3) + 0.1 * np.diag(rng.normal(size=3)))
    found = polar_rotation(C, np.zeros((9, 9)))
    np.testing.assert_allclose(found.R_mag_lidar, polar(C)[0], atol=1e-12)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_delta_method_agrees_with_differences(seed: int) -> None:
    """Perturb C, watch the rotation: covariance J J^T from central differences, step 1e-6."""
    rng = np.random.default_rng(seed)
    C = Rotation.random(rng=rng).as_matrix() @ (np.eye(3) + 0.05 * rng.normal(size=(3, 3)))
    root = rng.normal(size=(9, 9))
    R = polar_rotation(C, np.zeros((9, 9))).R_mag_lidar
    J = np.empty((3, 9))
    for k, step in enumerate(1e-6 * np.eye(9)):
        ends = [polar(C + sign * step.reshape(3, 3))[0] for sign in (1, -1)]
        turns = [Rotation.from_matrix(end @ R.T).as_rotvec() for end in ends]
        J[:, k] = (turns[0] - turns[1]) / 2e-6
    found = polar_rotation(C, root @ root.T).covariance
    np.testing.assert_allclose(found, J @ root @ root.T @ J.T, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_flipped_axis_is_named(axis: int) -> None:
    C = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    C[axis] *= -1.02
    with pytest.raises(CalibrationError, match=f"the sensor's {'xyz'[axis]} axis looks flipped"):
        polar_rotation(C, np.zeros((9, 9)))


def test_of_a_flat_matrix_no_axis_is_called_flipped() -> None:
    """What a drive hardly determines may have any sign: from a survey of 40 s in the hand."""
    C = np.array([[1.37, -1.16, -1.0], [-1.22, 1.04, 0.9], [-0.81, 0.69, 0.5]])
    assert np.linalg.det(C) < 0
    with pytest.raises(CalibrationError, match="C is nearly singular"):
        polar_rotation(C, np.zeros((9, 9)))
