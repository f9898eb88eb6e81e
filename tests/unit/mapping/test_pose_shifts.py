"""What errors of a survey's poses do to its readings: derivatives of what a map is given."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.mapping.shifts import survey_poses
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions

COUNT, STEP = 20, 1e-6
EXACT = PoseNoiseOptions(position_m=0, rotation_deg=0)
STATED = PoseNoiseOptions(position_m=0.01, rotation_deg=0.2, correlation_s=3.0)
t, b = np.array([0.3, -0.2, 0.1]), np.random.default_rng(1).normal(0, 40, (COUNT, 3))


def trajectory(covariance: FloatArray | None = None) -> Trajectory:
    rng = np.random.default_rng(0)
    stamps = 10**9 * np.arange(5, 5 + COUNT)
    R, p = Rotation.random(COUNT, rng).as_matrix(), rng.normal(size=(COUNT, 3))
    return Trajectory(stamps, R, p, "map", "lidar", covariance)


def given(R: FloatArray, p: FloatArray) -> FloatArray:
    """Return what a map is given with these poses, shape (N, 6)."""
    return np.hstack([R @ t + p, np.einsum("nij,nj->ni", R, b)])


def readings(way: Trajectory) -> Readings:
    one = np.zeros(COUNT, dtype=np.int64)
    return Readings(("mag",), one, way.stamp_ns, way.R, way.p, b)


def shifts(way: Trajectory, options: PoseNoiseOptions) -> FloatArray:
    told = given(way.R, way.p)
    poses = survey_poses(way, readings(way), told[:, :3], told[:, 3:], options)
    assert poses is not None
    return poses.shift


def test_shifts_are_the_derivatives_of_what_a_map_is_given() -> None:
    way, shift = trajectory(), shifts(trajectory(), PoseNoiseOptions())
    for k in range(3):
        turn = Rotation.from_rotvec(STEP * np.eye(3)[k]).as_matrix()
        # A map is given the poses that are stated: they are wrong by less of what is true.
        turned = (given(turn @ way.R, way.p) - given(way.R, way.p)) / -STEP
        np.testing.assert_allclose(shift[:, :, k], turned, atol=1e-4)
        moved = (given(way.R, way.p + STEP * np.eye(3)[k]) - given(way.R, way.p)) / -STEP
        np.testing.assert_allclose(shift[:, :, 3 + k], moved, atol=1e-4)


def test_what_is_stated_is_the_unit() -> None:
    unit = np.repeat([np.deg2rad(0.2), 0.01], 3)
    plain, stated = shifts(trajectory(), PoseNoiseOptions()), shifts(trajectory(), STATED)
    expected = plain * unit**2 @ plain.transpose(0, 2, 1)
    np.testing.assert_allclose(stated @ stated.transpose(0, 2, 1), expected, atol=1e-9)
    covariance = np.broadcast_to(np.diag(unit**2), (COUNT, 6, 6))
    by_bag = shifts(trajectory(covariance), PoseNoiseOptions())
    np.testing.assert_allclose(by_bag @ by_bag.transpose(0, 2, 1), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "stated", "lasting"), [(PoseNoiseOptions(), False, 1.0), (STATED, True, 3.0)]
)
def test_it_is_known_what_is_stated(
    options: PoseNoiseOptions, stated: bool, lasting: float
) -> None:
    way, told = trajectory(), np.zeros((COUNT, 3))
    poses = survey_poses(way, readings(way), told, told, options)
    assert poses is not None
    assert (poses.stated, poses.lasting_s) == (stated, lasting)
    assert survey_poses(way, readings(way), told, told, EXACT) is None
