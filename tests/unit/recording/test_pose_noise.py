"""Roots of the covariances of poses' errors at any time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.geometry import from_ros
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions, pose_roots

SCALE = np.repeat([1e-3, 1e-2], 3)
SECOND = 1_000_000_000


def drive(covariance: FloatArray | None, count: int = 5) -> Trajectory:
    """Poses one second apart."""
    R, p = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    return Trajectory(np.arange(count) * SECOND, R, p, "map", "lidar", covariance)


def some(seed: int, count: int = 5, rank: int = 6) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(count, 6, rank)) * SCALE[:, None]
    return np.asarray(root @ root.swapaxes(1, 2))


def squared(roots: FloatArray | None) -> FloatArray:
    assert roots is not None
    return roots @ roots.swapaxes(1, 2)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.lists(st.floats(-1, 6), max_size=20))
def test_roots_square_to_the_covariance_between_the_poses(
    seed: int, rank: int, seconds: list[float]
) -> None:
    """Reading by reading, against every array at once; of any rank."""
    trajectory = drive(some(seed, rank=rank))
    stamps = np.round(np.array([2.0, *seconds]) * SECOND).astype(np.int64)
    found = squared(pose_roots(trajectory, stamps, PoseNoiseOptions()))
    assert trajectory.covariance is not None
    for stamp, covariance in zip(stamps / SECOND, found, strict=True):
        low = int(np.clip(np.floor(stamp), 0, 3))
        share = np.clip(stamp - low, 0.0, 1.0)
        ends = trajectory.covariance[low], trajectory.covariance[low + 1]
        expected = (1 - share) * ends[0] + share * ends[1]
        # Eigenvalues to some roundings of the largest, up to 60 in units of the scale.
        scaled = (covariance - expected) / np.outer(SCALE, SCALE)
        assert np.abs(scaled).max() < 1e-12


def test_one_pose_holds_always() -> None:
    trajectory = drive(some(1, 1), 1)
    found = squared(pose_roots(trajectory, np.array([-SECOND, 0, SECOND]), PoseNoiseOptions()))
    assert trajectory.covariance is not None
    # Rounding of the largest entries, some 1e-3 m^2.
    np.testing.assert_allclose(found, np.tile(trajectory.covariance, (3, 1, 1)), atol=1e-17)


def test_rounding_below_zero_is_clipped() -> None:
    covariance = some(2, 2, rank=2) - 1e-9 * np.diag(SCALE**2)
    found = squared(pose_roots(drive(covariance, 2), np.array([0, SECOND]), PoseNoiseOptions()))
    # Four eigenvalues of -1e-9, in units of the scale, became 0.
    assert np.abs((found - covariance) / np.outer(SCALE, SCALE)).max() < 2e-9


STAMPS: IntArray = np.array([0, SECOND // 2])


def test_nothing_known_is_not_modelled() -> None:
    assert pose_roots(drive(None), STAMPS, PoseNoiseOptions()) is None
    exact = PoseNoiseOptions(position_m=0.0, rotation_deg=0.0)
    assert pose_roots(drive(some(3)), STAMPS, exact) is None


def test_options_stand_in_for_what_the_recording_does_not_say() -> None:
    both = PoseNoiseOptions(position_m=0.02, rotation_deg=0.5)
    root = np.diag([np.deg2rad(0.5)] * 3 + [0.02] * 3)
    for trajectory in (drive(None), drive(some(4))):
        found = pose_roots(trajectory, STAMPS, both)
        assert found is not None
        # Rounding of squares and roots.
        np.testing.assert_allclose(found, np.tile(root, (2, 1, 1)), rtol=1e-14)
    place = pose_roots(drive(None), STAMPS, PoseNoiseOptions(position_m=0.02))
    assert place is not None
    np.testing.assert_allclose(place[0], np.diag([0.0] * 3 + [0.02] * 3), rtol=1e-14)


def test_one_option_overrules_its_half_alone() -> None:
    trajectory = drive(some(5))
    found = squared(pose_roots(trajectory, STAMPS, PoseNoiseOptions(rotation_deg=0.1)))
    assert trajectory.covariance is not None
    expected = trajectory.covariance[0].copy()
    expected[:3] = expected[:, :3] = 0.0
    expected[:3, :3] = np.deg2rad(0.1) ** 2 * np.eye(3)
    # As above: roundings of the largest.
    np.testing.assert_allclose(found[0], expected, rtol=0, atol=1e-16)
    assert (trajectory.covariance == some(5)).all()  # and the recording is left as it was


def rolling(count: int) -> Trajectory:
    """A vehicle rolls to both sides; errors are planar: x, y and heading of the map alone."""
    angle = 0.05 * np.sin(np.linspace(0, 20, count))
    turns = np.column_stack([angle, 0.5 * angle, np.linspace(0, 3, count)])
    R = Rotation.from_rotvec(turns).as_matrix()
    ros = np.diag([1e-4, 1e-4, 0, 0, 0, 1e-6])
    ros[0, 5] = ros[5, 0] = 0.5e-5
    covariance = from_ros(np.tile(ros, (count, 1, 1)), R)
    stamps = np.arange(count) * (SECOND // 100)
    return Trajectory(stamps, R, np.zeros((count, 3)), "map", "lidar", covariance)


def test_roots_of_singular_covariances_turn_with_the_vehicle_without_jumps() -> None:
    coarse, fine = rolling(2001), rolling(4001)
    steps = []
    for trajectory in (coarse, fine):
        roots = pose_roots(trajectory, trajectory.stamp_ns, PoseNoiseOptions())
        assert roots is not None
        steps.append(np.abs(np.diff(roots / SCALE[:, None], axis=0)).max())
    # Half the step in time is half the step of a smooth function; a jump would stay.
    assert steps[1] == pytest.approx(steps[0] / 2, rel=0.05)


def test_a_time_has_one_root_whatever_else_is_asked() -> None:
    trajectory = drive(some(6))
    stamps = np.arange(0, 4 * SECOND, SECOND // 7)
    together = pose_roots(trajectory, stamps, PoseNoiseOptions())
    alone = pose_roots(trajectory, stamps[9:10], PoseNoiseOptions())
    assert together is not None
    assert alone is not None
    np.testing.assert_array_equal(together[9], alone[0])


@pytest.mark.parametrize("name", ["position_m", "rotation_deg", "correlation_s"])
def test_negative_options_are_refused(name: str) -> None:
    with pytest.raises(ValidationError, match=name):
        PoseNoiseOptions.model_validate({name: -1.0})
