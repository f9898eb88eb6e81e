"""Error modes of a harmonic map over a drive: all of its variance, tile with tile."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.error_modes import ErrorModes
from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import ErrorOptions
from l2m_gtsam.maps.harmonic.tiles import Tile
from tests.worlds.harmonic import PRIOR, queries, within_survey


@pytest.fixture(scope="module")
def errors(harmonic: HarmonicMap) -> ErrorModes:
    return harmonic.errors_over(within_survey())


def test_modes_tell_all_of_the_variance_but_a_rest(
    harmonic: HarmonicMap, errors: ErrorModes
) -> None:
    owner = errors.owner(within_survey())
    for index, size in errors.sizes().items():
        tile, at = harmonic.tiles[index], within_survey()[owner == index]
        A = errors.features(at, index)
        assert A.shape == (len(at), 3, size)
        told = np.einsum("nir,nir->ni", A, A)
        posterior = tile.variance(at) - tile.unresolved(at)
        # A projection of the posterior: never more, to rounding.
        assert (told <= posterior * (1 + 1e-8)).all()
        # Chosen at some of these places; the others are between them.
        assert told.sum() >= (1 - 1.5 * harmonic.options.errors.rest) * posterior.sum()


def test_all_modes_tell_all_of_the_variance(harmonic: HarmonicMap) -> None:
    at = within_survey()[:40]
    told = fine_errors(harmonic, at)
    owner = told.owner(at)
    for index in told.sizes():
        here = at[owner == index]
        A, tile = told.features(here, index), harmonic.tiles[index]
        posterior = tile.variance(here) - tile.unresolved(here)
        # Of the variance 1e-9 was left out, and eigenvectors of the rest have seven digits.
        np.testing.assert_allclose(np.einsum("nir,nir->ni", A, A), posterior, rtol=1e-6)


def fine_errors(harmonic: HarmonicMap, at: FloatArray) -> ErrorModes:
    """Return the errors with nothing left out."""
    options = harmonic.options.model_copy(update={"errors": ErrorOptions(rest=1e-9, places=1000)})
    return replace(harmonic, options=options).errors_over(at)


def test_errors_have_a_proper_covariance(errors: ErrorModes) -> None:
    covariance = errors.covariance
    assert covariance.shape == (sum(errors.sizes().values()),) * 2
    np.testing.assert_array_equal(covariance, covariance.T)
    np.testing.assert_array_equal(np.diag(covariance), 1.0)
    assert np.linalg.eigvalsh(covariance).min() > 1e-6
    assert np.abs(covariance - np.eye(len(covariance))).max() > 0.1  # tiles share readings


def test_places_belong_to_the_nearest_tile_with_modes(
    harmonic: HarmonicMap, errors: ErrorModes
) -> None:
    np.testing.assert_array_equal(
        errors.owner(within_survey()), harmonic.learnt.tiling.grid.block_of(within_survey())
    )
    one = harmonic.errors_over(within_survey()[:1])
    assert len(one.sizes()) == 1
    assert set(one.owner(queries()).tolist()) == set(one.sizes())


def test_no_places_have_no_errors(harmonic: HarmonicMap) -> None:
    nowhere = np.empty((0, 3))
    found = harmonic.errors_over(nowhere)
    assert found.covariance.shape == (0, 0)
    assert found.owner(nowhere).shape == (0,)


def noise_errors(
    harmonic: HarmonicMap,
    tile: Tile,
    rows: npt.NDArray[np.int64],
    noise: FloatArray,
    at: FloatArray,
) -> FloatArray:
    """Return what noise (N, 3, draws) makes of a tile's mean at a place, shape (3, draws).

    From the normal equations of the weights, beside the code under test.
    """
    kept, basis = harmonic.learnt.readings[rows], tile.basis
    prior = np.exp(-basis.prior(PRIOR).log_variance)
    information = normal_of(basis, kept).FF / PRIOR.noise**2 + np.diag(prior)
    F = basis.features(kept.points) * kept.weight[:, None, None] / PRIOR.noise**2
    seen = F.reshape(-1, len(basis)).T @ noise[rows].reshape(-1, noise.shape[2])
    return np.asarray(basis.features(at[None])[0] @ np.linalg.solve(information, seen))


def test_tiles_share_the_errors_that_shared_noise_makes(harmonic: HarmonicMap) -> None:
    """Surveys of one field that differ by their noise: covariance of two tiles' errors."""
    draws = 4000
    told = fine_errors(harmonic, within_survey(1500))
    sizes, kept = told.sizes(), harmonic.learnt.readings
    starts = dict(zip(sizes, np.cumsum([0, *sizes.values()])[:-1].tolist(), strict=True))
    rng = np.random.default_rng(8)
    noise = rng.normal(0, PRIOR.noise, (len(kept), 3, draws)) / np.sqrt(kept.weight)[:, None, None]
    middle = int(np.argmin(np.linalg.norm(harmonic.learnt.tiling.grid.centres, axis=1)))
    strongest = 0.0
    for other in [tile for tile in sizes if tile != middle][:4]:
        shared: list[FloatArray] = []
        border = np.append(harmonic.learnt.tiling.grid.centres[[middle, other]].mean(axis=0), 0.5)
        for tile in (middle, other):
            members = harmonic.learnt.members[tile]
            shared.append(noise_errors(harmonic, harmonic.tiles[tile], members, noise, border))
        empirical = shared[0] @ shared[1].T / draws
        A, B = (told.features(border[None], tile)[0] for tile in (middle, other))
        rows = slice(starts[middle], starts[middle] + sizes[middle])
        columns = slice(starts[other], starts[other] + sizes[other])
        expected = A @ told.covariance[rows, columns] @ B.T
        scale = np.sqrt(np.outer(shared[0].var(axis=1), shared[1].var(axis=1)))
        # A covariance of 4,000 draws errs by sqrt(2 / 4000) of the product of the sigmas at most:
        # 36 of them stay within four of that.
        np.testing.assert_allclose(empirical / scale, expected / scale, rtol=0, atol=0.09)
        strongest = max(strongest, float(np.abs(expected / scale).max()))
    assert strongest > 0.5


def test_covariance_between_points_is_that_of_the_map(harmonic: HarmonicMap) -> None:
    """Its diagonal is the variance; in one tile it is the posterior's; it is a covariance."""
    at = within_survey(60)
    covariance = harmonic.covariance(at)
    diagonal = np.einsum("nini->ni", covariance)
    np.testing.assert_allclose(diagonal, harmonic.variance(at), rtol=1e-6)
    flat = covariance.reshape(180, 180)
    np.testing.assert_allclose(flat, flat.T, atol=1e-12)
    assert np.linalg.eigvalsh(flat).min() > -1e-9 * diagonal.max()
    owner = harmonic.learnt.tiling.grid.block_of(at)
    same = np.flatnonzero(owner == owner[0])
    root = harmonic.tiles[int(owner[0])].root_rows(at[same])
    root = root.transpose(2, 1, 0).reshape(3 * len(same), -1)
    rows = (3 * same[:, None] + np.arange(3)).ravel()
    ours = flat[np.ix_(rows, rows)]
    between = ~np.eye(len(ours), dtype=np.bool_)
    # The directions left out hold a billionth of the variance.
    np.testing.assert_allclose(ours[between], (root @ root.T)[between], atol=1e-6 * diagonal.max())


def test_errors_of_near_places_are_alike_and_of_far_ones_are_not(harmonic: HarmonicMap) -> None:
    at = np.array([[0.0, 0.0, 0.5], [0.05, 0.0, 0.5], [1.4, 1.1, 0.5]])
    covariance = harmonic.covariance(at)
    sigma = np.sqrt(np.einsum("nini->ni", covariance))
    near, far = (np.diag(covariance[0, :, n]) / (sigma[0] * sigma[n]) for n in (1, 2))
    assert (near > 0.8).all()
    assert (np.abs(far) < 0.4).all()


def test_no_points_have_no_covariance(harmonic: HarmonicMap) -> None:
    assert harmonic.covariance(np.empty((0, 3))).shape == (0, 3, 0, 3)
