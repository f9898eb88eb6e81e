"""Covariances of poses between ROS and GTSAM, against derivatives of GTSAM's own poses."""

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import from_ros, moved, to_ros

SEEDS = st.integers(0, 2**32 - 1)
STEP = 1e-6


def some(seed: int, count: int = 4) -> tuple[FloatArray, FloatArray]:
    """Return covariances of rotations near 1e-3 rad and positions near 1e-2 m, and rotations."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, 6, 6)) * np.repeat([1e-3, 1e-2], 3)[:, None]
    return root @ root.swapaxes(1, 2), Rotation.random(count, random_state=seed).as_matrix()


def moved_along(pose: gtsam.Pose3, axis: int, step: float) -> gtsam.Pose3:
    return pose.compose(gtsam.Pose3.Expmap(step * np.eye(6)[axis]))


def ros_difference(one: gtsam.Pose3, other: gtsam.Pose3) -> FloatArray:
    """Return how two near poses differ in ROS' terms: dp, dr along the header frame's axes."""
    turn = Rotation.from_matrix(one.rotation().matrix() @ other.rotation().matrix().T)
    return np.concatenate([one.translation() - other.translation(), turn.as_rotvec()])


@given(SEEDS)
def test_there_and_back(seed: int) -> None:
    covariance, R = some(seed)
    back = from_ros(to_ros(covariance, R), R)
    # Four products of rotations on entries up to some 40 (1e-2 m)^2.
    np.testing.assert_allclose(back, covariance, rtol=0, atol=4e-16)


@given(SEEDS)
def test_ros_sees_what_a_right_perturbation_does(seed: int) -> None:
    covariance, R = some(seed, 1)
    pose = gtsam.Pose3(gtsam.Rot3(R[0]), np.array([30.0, -20.0, 5.0]))
    columns = [
        ros_difference(moved_along(pose, axis, STEP), moved_along(pose, axis, -STEP)) / (2 * STEP)
        for axis in range(6)
    ]
    J = np.column_stack(columns)
    # Central differences: rounding of 30 m over 2e-6, 2e-9 relative in J.
    expected = J @ covariance[0] @ J.T
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        to_ros(covariance, R)[0] / np.outer(size, size),
        expected / np.outer(size, size),
        rtol=0,
        atol=1e-7,
    )


def test_an_error_known_in_the_map() -> None:
    """1 cm along the map's x together with 1 mrad about its y, heading 30 degrees to the left."""
    in_map = np.array([1e-2, 0, 0, 0, 1e-3, 0])
    R = Rotation.from_euler("z", [[30]], degrees=True).as_matrix()
    cos, sin = np.sqrt(0.75), 0.5
    in_body = np.array([1e-3 * sin, 1e-3 * cos, 0, 1e-2 * cos, -1e-2 * sin, 0])
    found = from_ros(np.outer(in_map, in_map)[None], R)[0]
    # Rounding of products of the entries, 1e-4 at most.
    np.testing.assert_allclose(found, np.outer(in_body, in_body), rtol=0, atol=1e-19)


@given(SEEDS, st.floats(-5, 5), st.floats(-5, 5))
def test_another_body_by_the_adjoint(seed: int, x: float, z: float) -> None:
    covariance, (R, *_) = some(seed)
    t = np.array([x, 1.0, z])
    adjoint = gtsam.Pose3(gtsam.Rot3(R), t).inverse().AdjointMap()
    expected = adjoint @ covariance @ adjoint.T
    found = moved(covariance, RigidTransform(R, t))
    # Levers of up to 8 m on 1e-3 rad: entries up to 40 (8e-3 + 1e-2)^2 m^2, a few roundings.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15 * 40)


def test_a_lever_turns_a_rotation_into_a_shift() -> None:
    """1 mrad about z is 2 mm along y at 2 m ahead, wholly correlated."""
    covariance = np.zeros((1, 6, 6))
    covariance[0, 2, 2] = 1e-6
    found = moved(covariance, RigidTransform(np.eye(3), np.array([2.0, 0.0, 0.0])))[0]
    expected = np.zeros((6, 6))
    expected[np.ix_([2, 4], [2, 4])] = 1e-6 * np.array([[1, 2], [2, 4]])
    np.testing.assert_allclose(found, expected, rtol=1e-14)  # rounding
