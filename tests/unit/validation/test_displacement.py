"""Displacements of all poses: what they do, against poses that are displaced."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.records.validation import Displaced
from l2m_gtsam.validation.displacement import PoseDisplacement

SEEDS = st.integers(0, 10_000)
N = 4


def poses(rng: np.random.Generator) -> Trajectory:
    R = Rotation.random(N, random_state=rng).as_matrix()
    return Trajectory(np.arange(N), R, rng.normal(size=(N, 3)), "map", "lidar")


def right_perturbations(before: Trajectory, after: Trajectory) -> FloatArray:
    """Return what leads from some poses to others, to first order, shape (N, 6)."""
    back = before.R.transpose(0, 2, 1)
    turn = Rotation.from_matrix(back @ after.R).as_rotvec()
    return np.column_stack([turn, np.einsum("nij,nj->ni", back, after.p - before.p)])


@given(SEEDS, st.sampled_from(list(Displaced)))
def test_features_are_the_derivatives_of_displaced_poses(seed: int, of: Displaced) -> None:
    rng = np.random.default_rng(seed)
    given_ = poses(rng)
    nothing = PoseDisplacement(of, rng.normal(size=3), np.zeros(6))
    none = np.zeros(N, dtype=np.int64)
    readings = Readings(("mag",), none, given_.stamp_ns, given_.R, given_.p, np.zeros((N, 3)))

    def moved(vector: FloatArray) -> FloatArray:
        by = PoseDisplacement(of, nothing.centre, vector)
        return right_perturbations(given_, by.applied(given_)).ravel()

    step = 1e-5 * np.eye(6)
    expected = np.stack([(moved(each) - moved(-each)) / 2e-5 for each in step], axis=1)
    np.testing.assert_allclose(nothing.features(readings).reshape(6 * N, 6), expected, atol=1e-6)


@pytest.mark.parametrize("of", list(Displaced))
def test_a_displacement_turns_about_its_centre(of: Displaced) -> None:
    by = PoseDisplacement(of, np.array([1.0, 2.0, 3.0]), np.array([0, 0, 0.3, 0.1, 0, 0]))
    at = by.transform.R @ by.centre + by.transform.t
    np.testing.assert_allclose(at, by.centre + np.array([0.1, 0, 0]))
