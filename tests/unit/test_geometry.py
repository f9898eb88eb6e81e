"""Covariances of poses against derivatives of GTSAM's own poses, rotations against SciPy."""

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import from_ros, interpolated_rotations, moved, to_ros, turn_angle

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


@given(SEEDS, st.floats(0.0, np.pi))
def test_the_angle_of_a_rotation(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=(5, 3))
    vector = angle * axis / np.linalg.norm(axis, axis=1)[:, None]
    R = Rotation.from_rotvec(vector).as_matrix()
    # Of half a turn the cosine keeps the square of what is missing: root of the rounding.
    np.testing.assert_allclose(turn_angle(R), angle, rtol=1e-12, atol=1e-7 if angle > 3 else 1e-15)


@given(SEEDS, st.sampled_from([0.0, 1e-12, 1e-6, 0.1, 2.5, 3.1, np.pi]))
def test_rotations_are_interpolated_along_the_shortest_arc(seed: int, largest: float) -> None:
    """As SciPy does, from poses at rest to turns of nearly a half."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(7, 3))
    steps = largest * rng.uniform(size=(7, 1)) * axis / np.linalg.norm(axis, axis=1)[:, None]
    steps[3] = 0.0
    turned = [Rotation.random(random_state=seed)]
    for step in steps:
        turned.append(turned[-1] * Rotation.from_rotvec(step))
    R = np.stack([each.as_matrix() for each in turned])
    at = np.cumsum(rng.uniform(1e-3, 1.0, len(R)))
    between = np.concatenate([at, rng.uniform(at[0], at[-1], 20)])
    expected = Slerp(at, Rotation.from_matrix(R))(between).as_matrix()
    # Near half turns the sine of 0.14 divides rounding, 5e-15 in 3,000 seeds, twice.
    np.testing.assert_allclose(interpolated_rotations(R, at, between), expected, rtol=0, atol=3e-13)
