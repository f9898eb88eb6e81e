import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.near_sources import PointSources, add_near, near_sources
from l2m_gtsam.maps.harmonic.potential_grid import PotentialLattice

RADIUS = 0.7
LOWER, UPPER = np.array([-1.0, -1.3, -0.3]), np.array([2.1, 1.6, 1.2])


def sources(count: int = 30, seed: int = 0) -> PointSources:
    """Return sources inside and beside the box."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-1.5, -1.8, -0.5], [2.6, 2.1, 1.5], (count, 3))
    return PointSources(positions, rng.normal(0, 0.3, (count, 3)))


def places(count: int, seed: int = 1) -> FloatArray:
    rng = np.random.default_rng(seed)
    return rng.uniform(LOWER, UPPER, (count, 3))


def exact(of: PointSources, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    dipoles = Dipoles(of.positions, np.eye(3 * len(of)))
    return dipoles.field_and_gradient(points, of.moments.ravel())


def near(of: PointSources, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    field, gradient = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
    near = near_sources(of, LOWER, UPPER, RADIUS)
    add_near(points, near.corner, near.shape, near.starts, near.table, field, gradient)
    return field, gradient


def smooth(of: PointSources, point: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return differences of the smooth potential about one point."""
    lattice = PotentialLattice(point - step, step, np.ones((3, 3, 3), dtype=np.bool_))
    phi = of.smooth_potential(lattice, RADIUS)
    slopes = [np.gradient(phi, step, axis=i) for i in range(3)]
    field = np.array([slope[1, 1, 1] for slope in slopes])
    gradient = np.array([[np.gradient(s, step, axis=i)[1, 1, 1] for i in range(3)] for s in slopes])
    for axis in range(3):  # twice the same axis: by the second difference, not over two steps
        line = np.moveaxis(phi, axis, 0)[:, 1, 1]
        gradient[axis, axis] = (line[0] - 2 * line[1] + line[2]) / step**2
    return field, gradient


def test_both_parts_together_are_the_dipoles() -> None:
    of, points = sources(), places(60)
    field, gradient = exact(of, points)
    near_field, near_gradient = near(of, points)
    within = np.linalg.norm(points[:, None] - of.positions, axis=2) < RADIUS
    assert within.any(axis=1).sum() > 20  # or nothing is tested
    for n, point in enumerate(points):
        smooth_field, smooth_gradient = smooth(of, point, 1e-3)
        # Differences err by step^2 / 6 of the third derivative, which of the smooth part is at
        # most some hundred times the values: 1e-4; rounding by 1e-16 / step^2.
        np.testing.assert_allclose(near_field[n] + smooth_field, field[n], rtol=0, atol=1e-3)
        np.testing.assert_allclose(
            near_gradient[n] + smooth_gradient, gradient[n], rtol=0, atol=1e-2
        )


def test_the_near_part_is_symmetric_and_ends_at_the_radius() -> None:
    of, points = sources(), places(4000)
    field, gradient = near(of, points)
    np.testing.assert_array_equal(gradient, gradient.transpose(0, 2, 1))
    away = np.linalg.norm(points[:, None] - of.positions, axis=2).min(axis=1)
    far = away > RADIUS
    assert far.any()
    # Beyond the edge it is the rounding of terms of 0.3 uT m^3 / radius^3 and radius^4.
    np.testing.assert_allclose(field[far], 0, atol=1e-13)
    np.testing.assert_allclose(gradient[far], 0, atol=1e-12)
    fading = (away > 0.95 * RADIUS) & ~far
    assert fading.any()
    # The first six derivatives of the near part vanish at the edge.
    assert np.abs(gradient[fading]).max() < 1e-3 * np.abs(gradient).max()


def test_the_smooth_part_is_the_dipole_beyond_the_radius_and_none_at_the_source() -> None:
    of = PointSources(np.array([[0.0, 0.0, 0.0]]), np.array([[0.1, -0.2, 0.3]]))
    lattice = PotentialLattice(np.full(3, -1.5), 0.1, np.ones((31, 31, 31), dtype=np.bool_))
    phi = of.smooth_potential(lattice, RADIUS)
    nodes = np.stack(np.meshgrid(*lattice.axes, indexing="ij"), axis=-1)
    away = np.linalg.norm(nodes, axis=-1)
    outside = away > RADIUS
    expected = -(nodes[outside] @ of.moments[0]) / away[outside] ** 3
    np.testing.assert_allclose(phi[outside], expected, rtol=1e-12, atol=1e-14)
    assert abs(phi[15, 15, 15]) < 1e-12  # odd about the source
    # A dipole's potential falls with the distance; the smooth part stays near that at the edge.
    assert np.abs(phi[~outside]).max() < 4 * np.linalg.norm(of.moments[0]) / RADIUS**2


def test_a_weak_source_is_split_nearer() -> None:
    """With two moments the part that is left ends where the tenth root of their ratio says."""
    at = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    of = PointSources(at, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1e-3]]))
    np.testing.assert_allclose(of.radii(RADIUS), [RADIUS, RADIUS * 1e-3**0.1])
    for source, radius in zip(at, of.radii(RADIUS), strict=True):
        up = np.array([0.0, 0.0, radius])
        within, beyond = source + 0.9 * up, source + 1.001 * up
        field, _ = near(of, np.stack([within, beyond]))
        assert np.abs(field[0]).max() > 1e-9
        assert np.abs(field[1]).max() < 1e-13


def test_columns_that_are_not_needed_are_left_out() -> None:
    needed = np.zeros((4, 5, 6), dtype=np.bool_)
    needed[2, 3, 1] = True
    phi = sources().smooth_potential(PotentialLattice(np.zeros(3), 0.1, needed), RADIUS)
    assert (phi[2, 3] != 0).all()
    phi[2, 3] = 0.0
    assert not phi.any()


@pytest.mark.parametrize("point", [[-1.0, -1.3, -0.3], [2.1, 1.6, 1.2], [2.0999, -1.2999, 0.0]])
def test_corners_of_the_box_have_their_sources(point: list[float]) -> None:
    at = np.array([point])
    of = PointSources(at + np.full(3, 0.1), np.array([[0.1, 0.2, 0.3]]))
    field, _ = near(of, at)
    truth, _ = exact(of, at)
    smooth_field, _ = smooth(of, at[0], 1e-4)
    np.testing.assert_allclose(field[0], truth[0] - smooth_field, rtol=1e-4)


def test_beside_the_box_nothing_is_added() -> None:
    beyond = np.array([[-1.01, 0, 0], [0, -1.31, 0], [2.6, 0, 0], [1e300, 0, 0], [np.nan, 0, 0]])
    of = PointSources(beyond[:3] + 0.05, np.ones((3, 3)))
    field, gradient = near(of, beyond)
    assert not field.any()
    assert not gradient.any()


def test_no_sources_add_nothing() -> None:
    of = PointSources(np.empty((0, 3)), np.empty((0, 3)))
    field, gradient = near(of, places(5))
    assert not field.any()
    assert not gradient.any()
    assert not of.smooth_potential(
        PotentialLattice(np.zeros(3), 0.1, np.ones((2, 2, 2), dtype=np.bool_)), RADIUS
    ).any()
