"""Displacements of all poses: what they do, against poses that are displaced."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.records.validation import Displaced
from l2m_gtsam.validation.displacement import DisplacementTest, PoseDisplacement
from l2m_gtsam.validation.innovation import ChangeLikelihood

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


def shift_test(white: FloatArray) -> DisplacementTest:
    """A test of a lidar and a frame, each coordinate with an information of its own."""
    root = np.diag(np.repeat([300.0, 100.0, 200.0, 150.0], 3))
    starts = tuple(PoseDisplacement(of, np.zeros(3), np.zeros(6)) for of in Displaced)
    return DisplacementTest(starts, ChangeLikelihood(root, white, 0.0), np.log(1000))


def test_a_detectable_shift_is_missed_once_in_a_hundred_times() -> None:
    """2000 drives miss 20, and five standard errors more."""
    rng, missed = np.random.default_rng(3), 0
    (lidar, frame) = shift_test(np.zeros(12)).detectable(1e-3)
    assert (lidar.of, frame.of) == (Displaced.LIDAR, Displaced.FRAME)
    assert lidar.size == pytest.approx(1.5 * frame.size)
    for _ in range(2000):
        white = rng.normal(size=12)
        white[3] += 100.0 * lidar.size
        missed += not shift_test(white).shown(1e-3)
    assert missed == pytest.approx(20, abs=5 * np.sqrt(20))


def test_noise_shows_displacements_as_seldom_as_is_allowed() -> None:
    """Two of 2000, and five standard errors more."""
    rng = np.random.default_rng(4)
    shown = sum(bool(shift_test(rng.normal(size=12)).shown(1e-3)) for _ in range(2000))
    assert shown <= 2 + 5 * np.sqrt(2)
