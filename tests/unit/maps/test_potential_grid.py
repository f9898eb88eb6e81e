from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.potential_grid import (
    DEGREE,
    HALF_TAPS,
    Box,
    PotentialGrid,
    PotentialLattice,
    potential_grid,
)
from tests.support.central_differences import slopes

FIELD_TOLERANCE = 0.005  # uT, what the solvers are promised
GRADIENT_TOLERANCE = 0.02  # uT/m, what the solvers are promised
FELT = HALF_TAPS + DEGREE // 2 + 1  # cells: a value reaches no further

BOX = np.array([0.6, 0.6, 0.4])
EVERYWHERE = Box(np.full(3, -np.inf), np.full(3, np.inf))

Potential = Callable[[FloatArray], FloatArray]


def nodes_of(lattice: PotentialLattice) -> FloatArray:
    """Return all nodes, shape (nx, ny, nz, 3)."""
    return np.stack(np.meshgrid(*lattice.axes, indexing="ij"), axis=-1)


def grid_of(
    potential: Potential,
    points: FloatArray,
    reach: float,
    spacing: float,
    box: Box = EVERYWHERE,
) -> PotentialGrid:
    """Return the grid of a potential that is given point by point."""

    def on(lattice: PotentialLattice) -> FloatArray:
        return potential(nodes_of(lattice).reshape(-1, 3)).reshape(lattice.needed.shape)

    return potential_grid(on, points, reach, spacing, box)


@dataclass(frozen=True)
class Dipole:
    """A dipole with its closed forms."""

    place: FloatArray
    moment: FloatArray

    def potential(self, points: FloatArray) -> FloatArray:
        r = points - self.place
        return np.asarray(-(r @ self.moment) / np.linalg.norm(r, axis=1) ** 3)

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, m = points - self.place, self.moment
        d = np.linalg.norm(r, axis=1)[:, None]
        mr = (r @ m)[:, None]
        field = 3 * r * mr / d**5 - m / d**3
        mixed = r[:, :, None] * m + m[:, None] * r[:, None, :]
        outer = r[:, :, None] * r[:, None, :]
        d, mr = d[..., None], mr[..., None]
        gradient = 3 * (mixed + mr * np.eye(3)) / d**5 - 15 * mr * outer / d**7
        return field, gradient


@dataclass(frozen=True)
class Wave:
    """A harmonic of the floor with its closed forms: an amplitude in uT at height 0."""

    kx: float
    ky: float
    amplitude: float

    @property
    def k(self) -> float:
        return float(np.hypot(self.kx, self.ky))

    def potential(self, points: FloatArray) -> FloatArray:
        x, y, z = points.T
        scale = self.amplitude / self.k * np.exp(-self.k * z)
        return np.asarray(scale * np.cos(self.kx * x) * np.cos(self.ky * y))

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        (x, y, z), kx, ky, k = points.T, self.kx, self.ky, self.k
        scale = self.amplitude / k * np.exp(-k * z)
        cx, sx, cy, sy = np.cos(kx * x), np.sin(kx * x), np.cos(ky * y), np.sin(ky * y)
        field = np.asarray(-scale * np.stack([kx * sx * cy, ky * cx * sy, k * cx * cy]))
        xx, yy, zz = -kx * kx * cx * cy, -ky * ky * cx * cy, k * k * cx * cy
        xy, xz, yz = kx * ky * sx * sy, kx * k * sx * cy, ky * k * cx * sy
        gradient = scale * np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz])
        return field.T, gradient.T.reshape(-1, 3, 3)


def places(count: int, seed: int = 0) -> FloatArray:
    return np.asarray(np.random.default_rng(seed).uniform(0, 1, (count, 3)) * BOX)


def errors(source: Dipole | Wave, spacing: float) -> tuple[float, float]:
    """Return the largest errors of field and gradient in the box."""
    points = places(1500)
    grid = grid_of(source.potential, points, 0.1, spacing)
    field, gradient = grid.field_and_gradient(points)
    true_field, true_gradient = source.field_and_gradient(points)
    return float(np.abs(field - true_field).max()), float(np.abs(gradient - true_gradient).max())


def covered_by(grid: PotentialGrid, points: FloatArray) -> BoolArray:
    """Whether field and gradient are known at points."""
    field, gradient = grid.field_and_gradient(points)
    return np.asarray(np.isfinite(field).all(axis=1) & np.isfinite(gradient).all(axis=(1, 2)))


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), spacing=st.floats(0.04, 0.5))
def test_polynomials_are_reproduced(seed: int, spacing: float) -> None:
    rng = np.random.default_rng(seed)
    powers = rng.integers(0, DEGREE + 1, (12, 3))
    factors = rng.normal(size=12)

    def monomials(points: FloatArray, orders: tuple[int, int, int]) -> FloatArray:
        """Return the derivative of these orders of the polynomial."""
        value = np.tile(factors, (len(points), 1))
        for axis, order in enumerate(orders):
            p = powers[:, axis]
            for step in range(order):
                value = value * np.maximum(p - step, 0)
            value = value * points[:, axis, None] ** np.maximum(p - order, 0)
        return np.asarray(value.sum(axis=1))

    points = places(40, seed % 1000)
    grid = grid_of(lambda nodes: monomials(nodes, (0, 0, 0)), points, 0.05, spacing)
    field, gradient = grid.field_and_gradient(points)
    # Rounding of the values, which grow with the grid's extent, over the spacing (squared).
    rounding = 1e-12 * 12 * max(1.0, float(np.abs(grid.coefficients).max()))
    for i, axis in enumerate(np.eye(3, dtype=int)):
        expected = monomials(points, tuple(axis))
        np.testing.assert_allclose(field[:, i], expected, rtol=0, atol=rounding / spacing)
        for j, other in enumerate(np.eye(3, dtype=int)):
            expected = monomials(points, tuple(axis + other))
            np.testing.assert_allclose(
                gradient[:, i, j], expected, rtol=0, atol=rounding / spacing**2
            )


# Strengths are those of a field that varies by about 30 uT over the box.
NEAR = Dipole(np.array([0.3, 0.2, -0.35]), np.array([0.2, 0.1, 0.6]))
MIDDLE = Dipole(np.array([-0.6, 0.3, 0.2]), np.array([2.5, -1.5, 1.0]))
SHORT = Wave(7.2, 9.6, 15.0)
ALONG = Wave(12.0, 0.0, 15.0)
LONG = Wave(4.8, 3.6, 15.0)


@pytest.mark.parametrize(
    ("source", "spacing"),
    [(NEAR, 0.03), (MIDDLE, 0.05), (SHORT, 0.06), (ALONG, 0.06), (LONG, 0.12)],
)
def test_the_error_is_within_what_is_promised(source: Dipole | Wave, spacing: float) -> None:
    field, gradient = errors(source, spacing)
    assert field < FIELD_TOLERANCE
    assert gradient < GRADIENT_TOLERANCE


@pytest.mark.parametrize(("source", "spacing"), [(MIDDLE, 0.05), (SHORT, 0.06), (LONG, 0.12)])
def test_half_the_spacing_divides_the_error_by_the_order(
    source: Dipole | Wave, spacing: float
) -> None:
    wide, narrow = errors(source, spacing), errors(source, spacing / 2)
    # Orders 7 and 6; the field of a node's surroundings, which the filter sees, only helps. The
    # largest of random places varies by a part of this half order.
    assert narrow[0] < wide[0] / 2**6.5
    assert narrow[1] < wide[1] / 2**5.5


def test_the_gradient_is_the_derivative_of_the_field() -> None:
    points = places(200)
    grid = grid_of(MIDDLE.potential, points, 0.1, 0.08)
    _, gradient = grid.field_and_gradient(points)
    expected = slopes(lambda x: grid.field_and_gradient(x)[0], points, 1e-4)
    # Central differences err by step^2 / 6 of the third derivative of the field, which is
    # about 60 / d^3 of it with the source at d = 0.6: 1e-6; a wrong spline errs by 1e-3.
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=3e-6 * scale)


def test_the_gradient_is_symmetric() -> None:
    points = places(500)
    _, gradient = grid_of(NEAR.potential, points, 0.1, 0.1).field_and_gradient(points)
    np.testing.assert_array_equal(gradient, gradient.transpose(0, 2, 1))


def test_nothing_steps_from_cell_to_cell() -> None:
    points = places(300)
    grid = grid_of(NEAR.potential, points, 0.3, 0.1)
    for axis in range(3):
        at = points.copy()
        at[:, axis] = grid.lower[axis] + 0.1 * np.round((at[:, axis] - grid.lower[axis]) / 0.1)
        aside = 1e-10 * np.eye(3)[axis]
        before, after = (grid.field_and_gradient(at + side) for side in (-aside, aside))
        for one, other in zip(before, after, strict=True):
            # 2e-10 m times slopes of up to 100 times the values; the grid is too coarse for this
            # source, so that a spline with a step would show one of a thousandth and more.
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-7 * np.abs(one).max())


def test_a_value_is_felt_no_further_than_the_stencil() -> None:
    spacing, points = 0.1, places(300) * 10
    grid = grid_of(MIDDLE.potential, points, 0.1, spacing)

    def disturbed(nodes: FloatArray) -> FloatArray:
        return MIDDLE.potential(nodes) + 1e9 * (nodes[:, 0] > 4)

    far = points[points[:, 0] < 4 - FELT * spacing]
    near = points[points[:, 0] > 4 - (FELT - 2) * spacing]
    other = grid_of(disturbed, points, 0.1, spacing)
    for calm, shaken in zip(
        grid.field_and_gradient(far), other.field_and_gradient(far), strict=True
    ):
        np.testing.assert_array_equal(calm, shaken)
    assert (grid.field_and_gradient(near)[0] != other.field_and_gradient(near)[0]).all()


@pytest.mark.parametrize("reach", [0.0, 0.07, 0.3])
@pytest.mark.parametrize("corner", [[0.0, 0.0, 0.0], [-1e4, 3e4, 7.7]])
def test_the_grid_ends_beyond_the_reach(reach: float, corner: list[float]) -> None:
    spacing, points = 0.1, places(50) + corner
    grid = grid_of(lambda nodes: nodes[:, 0], points, reach, spacing)
    for side in np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T:
        assert covered_by(grid, points + reach * side).all()
    lowest, highest = points.min(axis=0), points.max(axis=0)
    for axis in np.eye(3):
        beyond = (reach + 2 * spacing) * axis
        assert not covered_by(grid, np.array([lowest - beyond, highest + beyond])).any()


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0, 0.3), spacing=st.floats(0.05, 0.3))
def test_covered_is_where_field_and_gradient_are_known(
    seed: int, reach: float, spacing: float
) -> None:
    rng = np.random.default_rng(seed)
    survey = rng.uniform(-1, 1, (4, 3)) * [6, 6, 1]
    grid = grid_of(lambda nodes: np.sin(nodes).sum(axis=1), survey, reach, spacing)
    points = rng.uniform(-1, 1, (400, 3)) * [7, 7, 2]
    points[:100] = survey[rng.integers(0, 4, 100)] + rng.uniform(-reach, reach, (100, 3))
    field, gradient = grid.field_and_gradient(points)
    covered = np.isfinite(field[:, 0])
    assert covered[:100].all()
    assert not covered.all()
    np.testing.assert_array_equal(np.isfinite(field), np.tile(covered[:, None], 3))
    np.testing.assert_array_equal(np.isfinite(gradient).all(axis=(1, 2)), covered)


def test_scattered_places_are_answered_in_their_own_order() -> None:
    points = places(3000) * [80, 80, 1]  # some forty blocks of cells
    wave = Wave(0.11, 0.07, 10.0)
    grid = grid_of(wave.potential, points, 0.1, 0.8)
    field, gradient = grid.field_and_gradient(points)
    for n in range(0, len(points), 100):
        alone = grid.field_and_gradient(points[n : n + 1])
        np.testing.assert_array_equal(field[n], alone[0][0])
        np.testing.assert_array_equal(gradient[n], alone[1][0])


def test_the_potential_is_needed_only_near_the_survey() -> None:
    spacing, reach = 0.1, 0.2
    survey = np.array([[0.0, 0.0, 0.0], [3.0, 2.0, 1.0]])
    asked: list[PotentialLattice] = []

    def potential(lattice: PotentialLattice) -> FloatArray:
        asked.append(lattice)
        x = nodes_of(lattice)[..., 0]
        return np.where(lattice.needed, x, 1e9)  # what is not needed must not be used

    grid = potential_grid(potential, survey, reach, spacing, EVERYWHERE)
    (lattice,) = asked
    nodes = nodes_of(lattice)[lattice.needed]
    away = np.abs(nodes[:, None] - survey).max(axis=2).min(axis=1)
    assert away.max() <= reach + (FELT + 2) * spacing
    assert not covered_by(grid, survey.mean(axis=0)[None]).any()
    assert np.isnan(grid.field_and_gradient(survey.mean(axis=0)[None])[0]).all()
    field, _ = grid.field_and_gradient(survey)
    np.testing.assert_allclose(field, [[1, 0, 0]] * 2, atol=1e-9)  # rounding over the spacing


def test_a_box_ends_the_grid() -> None:
    spacing, points = 0.1, places(300) * 10
    box = Box(np.array([1.0, -np.inf, 0.7]), np.array([2.5, 4.0, np.inf]))
    whole = grid_of(MIDDLE.potential, points, 0.2, spacing)
    part = grid_of(MIDDLE.potential, points, 0.2, spacing, box)
    inside = ((points >= box.lower) & (points <= box.upper)).all(axis=1)
    assert covered_by(part, points[inside]).all()
    beyond = ((points < box.lower - 2 * spacing) | (points > box.upper + 2 * spacing)).any(axis=1)
    assert beyond.any()
    assert not covered_by(part, points[beyond]).any()
    for one, other in zip(
        part.field_and_gradient(points[inside]),
        whole.field_and_gradient(points[inside]),
        strict=True,
    ):
        # Nodes lie elsewhere: both err by what the spacing allows, far from the source.
        np.testing.assert_allclose(one, other, rtol=0, atol=GRADIENT_TOLERANCE)


@pytest.mark.parametrize("hole", [np.inf, -np.inf, np.nan])
def test_places_beside_a_node_without_a_value_are_not_covered(hole: float) -> None:
    points = places(1000) * 4
    source = np.array([2.0, 1.2, 0.8])

    def potential(nodes: FloatArray) -> FloatArray:
        away = np.linalg.norm(nodes - source, axis=1)
        return np.where(away < 0.1, hole, MIDDLE.potential(nodes))

    grid = grid_of(potential, points, 0.0, 0.1)
    away = np.abs(points - source).max(axis=1)
    covered = covered_by(grid, points)
    assert covered[away > 0.1 * (FELT + 1)].all()
    assert not covered[away < 0.1 * (FELT - 2)].any()
    assert np.isfinite(grid.field_and_gradient(points[covered])[1]).all()


@pytest.mark.parametrize("far", [1e6, 1e100, 1e308])
def test_places_far_away_are_not_covered(far: float) -> None:
    grid = grid_of(lambda nodes: nodes[:, 0], places(5), 0.1, 0.1)
    points = far * np.vstack([np.eye(3), -np.eye(3)])
    assert not covered_by(grid, points).any()
    assert np.isnan(grid.field_and_gradient(points)[0]).all()


def test_no_places_give_no_answers() -> None:
    grid = grid_of(lambda nodes: nodes[:, 0], places(5), 0.1, 0.1)
    field, gradient = grid.field_and_gradient(np.empty((0, 3)))
    assert field.shape == (0, 3)
    assert gradient.shape == (0, 3, 3)


@pytest.mark.parametrize("far", [1e3, 1e8])
def test_a_grid_that_would_be_too_large_is_refused(far: float) -> None:
    points = far * np.eye(3)
    with pytest.raises(MapError, match=r"spacing 0.05 m would have .* raise the spacing"):
        grid_of(lambda nodes: nodes[:, 0], points, 0.1, 0.05)


def test_places_that_are_not_finite_are_not_covered() -> None:
    grid = grid_of(lambda nodes: nodes[:, 0], places(5), 0.1, 0.1)
    bad = np.full((3, 3), 0.3)
    bad[np.diag_indices(3)] = [np.nan, np.inf, -np.inf]
    assert not covered_by(grid, bad).any()
    assert np.isnan(grid.field_and_gradient(bad)[1]).all()


def test_a_grid_needs_a_point() -> None:
    with pytest.raises(MapError, match="at least one is needed"):
        grid_of(lambda nodes: nodes[:, 0], np.empty((0, 3)), 0.1, 0.1)
