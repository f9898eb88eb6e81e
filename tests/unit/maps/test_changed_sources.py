"""Sources that changed since a survey: their field, and how they are found."""

from typing import Any

import magpylib
import numpy as np
import pytest

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.sources.changed_map import ChangedMap
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources
from l2m_gtsam.maps.sources.source import SourceShape
from tests.worlds.loop_rows import BAR, DIPOLE, loop_path, rows_with


@pytest.mark.parametrize("half", [0.25, 0.5, 1.0])
def test_a_bar_is_that_of_magpylib(half: float) -> None:
    """A thin magnet; quadrature leaves a fiftieth at a fifth of its length from its end."""
    bar = DIPOLE.with_half_axis(np.array([0.0, 0.0, half]))
    volume = 0.01**2 * 2 * half
    library: Any = magpylib  # its classes carry no types
    magnet = library.magnet.Cuboid(
        dimension=(0.01, 0.01, 2 * half), magnetization=bar.moment / volume, position=bar.position
    )
    points = loop_path()[np.linalg.norm(loop_path() - bar.position, axis=1) > 0.9 * half]
    field, _ = bar.field_and_gradient(points)
    expected = 1e6 * magnet.getB(points)
    assert np.abs(field - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.parametrize("shape", [DIPOLE, BAR])
def test_derivatives_are_those_of_the_field(shape: SourceShape) -> None:
    points, step = loop_path()[::17], 1e-5
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
    field, _ = shape.field_and_gradient(loop_path())
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
    field, _ = DIPOLE.field_and_gradient(loop_path())
    found = find_sources(rows_with(field, 2), loop_path(), SourceSearchOptions(), None)
    changed, surveyed = ChangedMap(Uniform(), found), Uniform()
    sample = changed.query(loop_path())
    expected = surveyed.query(loop_path()).field + found.field(loop_path())
    assert np.array_equal(sample.field, expected)
    assert np.array_equal(sample.inside, loop_path()[:, 0] > 0)
    assert np.array_equal(changed.field_and_gradient(loop_path())[0], sample.field)
