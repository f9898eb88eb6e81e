"""Sources that changed since a survey: their field, and how they are found."""

from typing import Any

import magpylib
import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.sources.changed_map import ChangedMap
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources
from l2m_gtsam.maps.sources.source import SourceShape

NOISE_UT = 0.1
DIPOLE = SourceShape.dipole(np.array([1.0, 0.8, 0.5]), np.array([3.0, -2.0, 9.0]))
BAR = DIPOLE.with_half_axis(np.array([0.0, 0.0, 0.5]))


def path() -> FloatArray:
    """Return a loop about 3 by 2 m, two sensors 0.2 m apart, metres, shape (240, 3)."""
    turn = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    loop = np.column_stack([1 + 1.5 * np.cos(turn), np.sin(turn), np.zeros(120)])
    return np.concatenate([loop, loop + np.array([0.0, 0.2, 0.1])])


def rows_with(field: FloatArray, seed: int) -> MarginalRows:
    """Return rows with white noise and an unknown uniform field for each sensor."""
    points = path()
    noise = NOISE_UT * np.random.default_rng(seed).normal(size=points.shape)
    offset = np.kron(np.repeat(np.eye(2), 120, axis=0), np.eye(3))
    white = csr_array(eye_array(3 * len(points)) / NOISE_UT)
    return MarginalRows(
        points=points,
        residual=field + noise + np.repeat([[3.0, -1.0, 2.0], [0.0, 5.0, -4.0]], 120, axis=0),
        whitening=white,
        nuisance=csr_array(white @ offset),
        prior=1e-4 * np.eye(6),
        slot=np.tile(np.arange(120), 2),
    )


@pytest.mark.parametrize("half", [0.25, 0.5, 1.0])
def test_a_bar_is_that_of_magpylib(half: float) -> None:
    """A thin magnet; quadrature leaves a fiftieth at a fifth of its length from its end."""
    bar = DIPOLE.with_half_axis(np.array([0.0, 0.0, half]))
    volume = 0.01**2 * 2 * half
    library: Any = magpylib  # its classes carry no types
    magnet = library.magnet.Cuboid(
        dimension=(0.01, 0.01, 2 * half), magnetization=bar.moment / volume, position=bar.position
    )
    points = path()[np.linalg.norm(path() - bar.position, axis=1) > 0.9 * half]
    field, _ = bar.field_and_gradient(points)
    expected = 1e6 * magnet.getB(points)
    assert np.abs(field - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.parametrize("shape", [DIPOLE, BAR])
def test_derivatives_are_those_of_the_field(shape: SourceShape) -> None:
    points, step = path()[::17], 1e-5
    analytic = shape.derivatives(points)
    for k in range(9):
        ends = []
        for sign in (1, -1):
            vector = shape.vector.copy()
            # With no length at all a dipole is evaluated at one node: a bar of nothing is the same.
            vector[8] += 1e-9
            vector[k] += sign * step
            ends.append(SourceShape(vector).field_and_gradient(points)[0])
        numeric = (ends[0] - ends[1]) / (2 * step)
        # central differences leave step^2 times third derivatives, about 1e3 uT/m^3
        assert np.allclose(analytic[:, :, k], numeric, atol=1e-5 * max(1, np.abs(numeric).max()))


def test_information_is_that_of_the_whole_covariance() -> None:
    """By Woodbury's identity, against the inverse of a dense matrix."""
    rows = rows_with(np.zeros((240, 3)), 1)
    features = DIPOLE.derivatives(rows.points)[:, :, :6]
    V, X = rows.whitening.toarray(), rows.nuisance.toarray()
    S = np.eye(len(V)) + X @ np.linalg.inv(rows.prior) @ X.T
    white = V @ features.reshape(len(V), -1)
    expected = white.T @ np.linalg.solve(S, white)
    # a prior of 1e4 uT^2 beside noise of 0.01 loses six of sixteen digits
    assert np.allclose(rows.information(features), expected, rtol=1e-6, atol=1e-6 * expected.max())
    pulled, squared = rows.pull(rows.residual)
    e = V @ rows.residual.ravel()
    assert np.isclose(squared, e @ np.linalg.solve(S, e), rtol=1e-5)
    gradient = np.einsum("nim,ni->m", features, pulled)
    assert np.allclose(gradient, white.T @ np.linalg.solve(S, e), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("shape", [DIPOLE, BAR])
def test_a_source_is_found_as_it_is(shape: SourceShape) -> None:
    field, _ = shape.field_and_gradient(path())
    rows = rows_with(field, 2)
    found = find_sources(rows, rows.points, SourceSearchOptions(), None)
    assert len(found) == 1
    assert found.shapes[0].is_bar == shape.is_bar
    free = np.diag(found.covariance) > 0
    error = (found.shapes[0].vector - shape.vector)[free]
    half = found.shapes[0].half_axis[2]
    if half < 0:  # its other end
        error[-1] = -half - shape.half_axis[2]
    sigma = np.sqrt(np.diag(found.covariance)[free])
    assert np.abs(error / sigma).max() < 5  # of seven: chance one in a million


@pytest.mark.parametrize("seed", range(5))
def test_noise_makes_no_source(seed: int) -> None:
    rows = rows_with(np.zeros((240, 3)), 10 + seed)
    assert not len(find_sources(rows, rows.points, SourceSearchOptions(), None))


class Uniform:
    """A map of one field."""

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        return np.tile([20.0, 0.0, -40.0], (len(points), 1)), np.zeros((len(points), 3, 3))

    def query(self, points: FloatArray, /) -> FieldSample:
        inside = points[:, 0] > 0
        return FieldSample(*self.field_and_gradient(points), np.ones((len(points), 3)), inside)


def test_a_changed_map_has_the_field_of_both() -> None:
    field, _ = DIPOLE.field_and_gradient(path())
    found = find_sources(rows_with(field, 2), path(), SourceSearchOptions(), None)
    changed, surveyed = ChangedMap(Uniform(), found), Uniform()
    sample = changed.query(path())
    expected = surveyed.query(path()).field + found.field(path())
    assert np.array_equal(sample.field, expected)
    assert np.array_equal(sample.inside, path()[:, 0] > 0)
    assert np.array_equal(changed.field_and_gradient(path())[0], sample.field)
