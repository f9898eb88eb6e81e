"""Families of harmonic functions and bases of them: derivatives, priors, what is left out."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.family import Family
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, Modes, left_out, modes_up_to
from tests.reference.potentials import features, potential, potential_of_basis
from tests.support.central_differences import slopes
from tests.worlds.harmonic import FAMILIES, GIVEN, SIZE, TILTED, basis, places

EACH_FAMILY = pytest.mark.parametrize("name", list(FAMILIES))


def weights_for(family: Family | Basis) -> FloatArray:
    return np.random.default_rng(2).normal(size=len(family))


def assert_derivative(analytic: FloatArray, numeric: FloatArray) -> None:
    # Step 1e-4 m: 1e-8 / 6 of a third derivative, which is at most 300 times the slope (a source
    # 0.3 m away), and rounding of 1e-16 / 1e-4: 1e-6 of the largest entry at worst.
    scale = np.abs(analytic).max() + 1e-12
    np.testing.assert_allclose(analytic / scale, numeric / scale, rtol=0, atol=2e-6)


@EACH_FAMILY
def test_the_field_is_the_gradient_of_the_potential(name: str) -> None:
    family = FAMILIES[name]
    w = weights_for(family)
    field, gradient = family.field_and_gradient(places(), w)
    assert_derivative(field, slopes(lambda x: potential(family, x, w), places(), 1e-4))
    numeric = slopes(lambda x: family.field_and_gradient(x, w)[0], places(), 1e-4)
    np.testing.assert_allclose(gradient, numeric, rtol=0, atol=2e-6 * (1 + np.abs(gradient).max()))


@EACH_FAMILY
def test_features_times_weights_are_the_field(name: str) -> None:
    family = FAMILIES[name]
    w = weights_for(family)
    field, _ = family.field_and_gradient(places(), w)
    # The same sums in another order.
    scale = np.abs(field).max()
    np.testing.assert_allclose(features(family, places()) @ w, field, rtol=0, atol=1e-12 * scale)


@EACH_FAMILY
def test_slopes_of_the_prior_are_derivatives_by_log_hyperparameters(name: str) -> None:
    family = FAMILIES[name]
    analytic = family.prior(GIVEN).slopes
    for parameter, value in GIVEN.model_dump().items():
        up, down = (
            family.prior(GIVEN.model_copy(update={parameter: value * np.exp(d)})).log_variance
            for d in (1e-5, -1e-5)
        )
        told = analytic.get(parameter, np.zeros(len(family)))
        # Rounding of 1e-15 over the step, and its square times curvature of up to 2 k h = 30.
        np.testing.assert_allclose(told, (up - down) / 2e-5, rtol=0, atol=1e-8)


@pytest.mark.parametrize("side", [FLOOR, CEILING])
def test_modes_are_all_those_up_to_a_wave_number(side: str) -> None:
    modes = modes_up_to(side, SIZE, 0.0, 4.0)
    every = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2)
    k = np.pi * np.linalg.norm(every / SIZE, axis=1)
    expected = every[(k > 0) & (k <= 4.0)]
    assert sorted(map(tuple, modes.numbers.tolist())) == sorted(map(tuple, expected.tolist()))
    falls = modes.kz < 0
    assert falls.all() if side == FLOOR else not falls.any()
    np.testing.assert_allclose(np.abs(modes.kz), np.hypot(modes.kx, modes.ky), rtol=1e-15)


@pytest.mark.parametrize("name", ["floor", "ceiling"])
def test_the_potential_on_a_lattice_is_that_at_its_nodes(name: str) -> None:
    modes = FAMILIES[name]
    assert isinstance(modes, Modes)
    x, y, z = np.linspace(0, 3, 5), np.linspace(0, 2, 4), np.linspace(-0.2, 1, 3)
    nodes = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    w = weights_for(modes)
    flat = potential(modes, nodes.reshape(-1, 3), w).reshape(5, 4, 3)
    np.testing.assert_allclose(modes.potential_on(x, y, z, w), flat, rtol=0, atol=1e-12)


def test_a_basis_turns_its_families_into_the_map_frame() -> None:
    tilted = basis()
    w, frame = weights_for(tilted), tilted.frame
    points = places() @ TILTED.T + frame.corner
    np.testing.assert_allclose(frame.localise(points), places(), rtol=0, atol=1e-13)
    field, gradient = tilted.field_and_gradient(points, w)
    assert_derivative(field, slopes(lambda x: potential_of_basis(tilted, x, w), points, 1e-4))
    numeric = slopes(lambda x: tilted.field_and_gradient(x, w)[0], points, 1e-4)
    np.testing.assert_allclose(gradient, numeric, rtol=0, atol=2e-6 * np.abs(gradient).max())
    scale = np.abs(field).max()
    np.testing.assert_allclose(tilted.features(points) @ w, field, rtol=0, atol=1e-12 * scale)


def test_batches_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    tilted, points = basis(), places(50)
    w = weights_for(tilted)
    one = (*tilted.field_and_gradient(points, w), tilted.features(points))
    monkeypatch.setattr("l2m_gtsam.maps.harmonic.basis.BATCH", 7)
    other = (*tilted.field_and_gradient(points, w), tilted.features(points))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(a).max())


@pytest.mark.parametrize("side", [FLOOR, CEILING])
def test_what_is_left_out_is_the_sum_over_the_modes_beyond(side: str) -> None:
    """In a box of 12 m the sum over modes is the integral to the step of 1 / (k_max L): 2 %."""
    edge, k_max = 12.0, 4.0
    z = np.array([0.0, 0.1, 0.4])
    modes = modes_up_to(side, np.full(2, edge), 0.0, 40.0)
    rest = np.abs(modes.kz) > k_max
    variance = np.exp(modes.prior(GIVEN).log_variance) * rest
    away = z if side == FLOOR else -z
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.2 * edge, 0.8 * edge, (150, 2))
    scale, depth = getattr(GIVEN, f"{side}_scale"), getattr(GIVEN, f"{side}_depth")
    expected = left_out(scale, depth, k_max, z)
    for height, told in zip(away, expected, strict=True):
        F = features(modes, np.column_stack([xy, np.full(150, height)]))
        mean = np.einsum("nim,nim,m->i", F, F, variance) / 150
        # 150 places average the standing waves to a few per cent.
        np.testing.assert_allclose(mean, told * np.array([0.5, 0.5, 1.0]), rtol=0.1)


def test_nothing_left_out_is_the_whole_prior() -> None:
    """Documented scale: the horizontal field's deviation per axis at the lowest reading."""
    assert left_out(3.0, 0.7, 0.0, np.zeros(1))[0] / 2 == pytest.approx(9.0)
    # Nearer to the sources there is more, but no infinity short of them.
    nearer = left_out(3.0, 0.7, 2.0, np.array([1.0, 0.0, -0.5, -0.63]))
    assert np.isfinite(nearer).all()
    assert (np.diff(nearer) > 0).all()
