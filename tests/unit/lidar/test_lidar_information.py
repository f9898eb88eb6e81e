"""What matched planes say of a pose: against differences of their distances, and against noise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import difference, perturbed
from l2m_gtsam.lidar.surface import Planes, distances, fitted_planes, inflated, plane_information


def unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def exact_planes(rng: np.random.Generator, count: int = 50) -> Planes:
    """Planes without errors."""
    normal = unit(rng.standard_normal((count, 3)))
    point = rng.uniform(-5, 5, (count, 3))
    return Planes(point, normal, np.zeros((count, 2, 3)), np.zeros(count))


def pose(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-3, 3, 3))


@pytest.mark.parametrize("seed", range(3))
def test_information_is_the_square_of_the_distances_derivative(seed: int) -> None:
    rng = np.random.default_rng(seed)
    planes, T, points = exact_planes(rng), pose(rng), rng.uniform(-5, 5, (50, 3))
    h = 1e-6
    columns = [
        (distances(points, perturbed(T, step), planes) - distances(points, T, planes)) / h
        for step in h * np.eye(6)
    ]
    J = np.column_stack(columns)
    # One-sided differences: wrong by h times second derivatives of at most 5 m.
    expected = J.T @ J / 0.02**2
    found = plane_information(points, T, planes, 0.02)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("seed", range(5))
def test_errors_of_normals_are_no_information(seed: int) -> None:
    """Walls along x, floor and ceiling: 2,000 normals off by a degree would hold x to 6 mm."""
    rng = np.random.default_rng(seed)
    count, sigma, slope = 2000, 0.01, 0.02
    true = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[np.arange(count) % 2]
    across = np.cross(true, [1.0, 0.0, 0.0])
    tangents = np.stack([np.broadcast_to([1.0, 0.0, 0.0], true.shape), across], axis=1)
    errors = slope * rng.standard_normal((count, 2))
    normal = unit(true + np.einsum("nk,nki->ni", errors, tangents))
    points = np.column_stack([rng.uniform(-10, 10, count), rng.uniform(-1.5, 1.5, (count, 2))])
    T = RigidTransform(np.eye(3), np.zeros(3))
    planes = Planes(points, normal, slope * tangents, np.zeros(count))
    naive = Planes(points, normal, np.zeros((count, 2, 3)), np.zeros(count))
    assert plane_information(points, T, naive, sigma)[3, 3] ** -0.5 < 0.02
    information = plane_information(points, T, planes, sigma)
    x = np.array([0, 0, 0, 1.0, 0, 0])
    # Nothing is left of it but rounding; y and z are known as well as 1,000 points let them be.
    values, vectors = np.linalg.eigh(information)
    assert values[0] < 1e-6 * values[1]
    assert abs(vectors[3, 0]) > 0.99 * np.linalg.norm(vectors[3:, 0])
    assert np.sqrt(x @ np.linalg.inv(information + 1e-2 * np.eye(6)) @ x) > 5.0
    for axis in (4, 5):
        assert information[axis, axis] ** -0.5 == pytest.approx(sigma / np.sqrt(1000), rel=0.1)


def test_planes_are_fitted_with_their_errors() -> None:
    """Slopes of planes through noisy points scatter as their stated errors say."""
    rng = np.random.default_rng(1)
    count, per = 4000, 15
    flat = np.concatenate([rng.uniform(-0.3, 0.3, (count, per, 2)), np.zeros((count, per, 1))], 2)
    points = flat + 0.01 * rng.standard_normal(flat.shape) * [0, 0, 1]
    planes = fitted_planes(points[:, 0], points)
    normal = planes.normal * np.sign(planes.normal[:, 2:])
    off = np.stack([np.einsum("ni,ni->n", planes.slope[:, k], normal) for k in (0, 1)])
    np.testing.assert_allclose(off, 0, atol=1e-12)  # errors lie in the plane
    size = np.linalg.norm(planes.slope, axis=2)
    along = np.einsum("nki,i->nk", planes.slope / size[:, :, None], np.array([0, 0, 1.0]))
    # The vertical's component along a tangent is the slope's error; 8,000 of them: 1 % and more.
    assert np.std(along / size) == pytest.approx(1.0, rel=0.1)


def test_wide_neighbourhoods_are_no_planes() -> None:
    rng = np.random.default_rng(0)
    near = rng.uniform(-0.2, 0.2, (1, 15, 3)) * [1, 1, 0]
    assert fitted_planes(near[:, 0], near).flat.all()
    assert not fitted_planes(10 * near[:, 0], 10 * near).flat.any()


def test_tempered_information_is_that_of_the_sum_of_covariances() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6))
    information, least = root @ root.T, np.diag(rng.uniform(0.1, 1.0, 6))
    expected = np.linalg.inv(np.linalg.inv(information) + least)
    np.testing.assert_allclose(inflated(information, least), expected, rtol=1e-9)
    singular = root[:, :4] @ root[:, :4].T
    assert np.linalg.matrix_rank(inflated(singular, least), tol=1e-9) == 4


@pytest.mark.parametrize("seed", range(3))
def test_a_difference_leads_from_one_pose_to_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = pose(rng), pose(rng)
    back = perturbed(one, difference(one, other))
    np.testing.assert_allclose(back.R, other.R, atol=1e-12)
    np.testing.assert_allclose(back.t, other.t, atol=1e-12)
