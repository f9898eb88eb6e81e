"""What Maxwell's equations demand of the harmonic map, and what they give it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic import frame
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, modes_up_to
from l2m_gtsam.maps.sliding_gp import SlidingGP
from tests.reference.potentials import features
from tests.support.central_differences import slopes
from tests.worlds.exact import DIPOLE_CONSTANT, DipoleWorld
from tests.worlds.harmonic import OPTIONS, POST, PRIOR, WORLD, fitted_map, rms
from tests.worlds.harmonic import readings as readings_at_a_post

KEEP_ALL = OPTIONS.model_copy(update={"merge": 1e-6})


def survey_points(count: int, low: float, high: float, seed: int) -> FloatArray:
    return np.random.default_rng(seed).uniform([-1.5, -1.2, low], [1.5, 1.2, high], (count, 3))


def noise(count: int) -> FloatArray:
    return np.random.default_rng(7).normal(0, PRIOR.noise, (count, 3))


def readings(count: int = 600) -> tuple[FloatArray, FloatArray]:
    points = survey_points(count, 0.2, 0.8, seed=0)
    return points, WORLD.field_and_gradient(points)[0] + noise(count)


def within_survey(count: int = 300, low: float = 0.2, high: float = 0.8) -> FloatArray:
    return survey_points(count, low, high, seed=1) * [0.95, 0.95, 1]


@pytest.fixture(scope="module")
def field_map() -> HarmonicMap:
    """Several tiles, with a post that carries sources."""
    ours = fitted_map()
    assert len(ours.tiles) > 3
    return ours


def divergence_and_curl(gradient: FloatArray) -> float:
    """Largest divergence or component of the curl, relative to the largest gradient."""
    divergence = np.trace(gradient, axis1=1, axis2=2)
    curl = gradient - gradient.transpose(0, 2, 1)
    return float(max(np.abs(divergence).max(), np.abs(curl).max()) / np.abs(gradient).max())


def test_the_mean_has_no_divergence_and_no_curl(field_map: HarmonicMap) -> None:
    """Inside, between tiles, and where a trial step of a solver may go; to rounding."""
    around = np.random.default_rng(2).uniform([-4, -4, -0.2], [4, 4, 2], (500, 3))
    for points in (within_survey(), around):
        _, gradient = field_map.field_and_gradient(points)
        assert divergence_and_curl(gradient) < 1e-12


def test_every_single_feature_has_no_divergence_and_no_curl(field_map: HarmonicMap) -> None:
    tile = field_map.tiles[len(field_map.tiles) // 2]
    points = within_survey(20)
    for unit in np.eye(len(tile.basis))[3:]:  # the first three are the uniform field
        _, gradient = tile.basis.field_and_gradient(points, unit)
        assert divergence_and_curl(gradient) < 1e-11  # terms of a dipole cancel to a tenth


def differences(field_map: HarmonicMap, points: FloatArray, step: float = 1e-4) -> FloatArray:
    """Return the gradient by central differences, shape (N, 3, 3)."""
    return slopes(lambda x: field_map.field_and_gradient(x)[0], points, step)


def alone(field_map: HarmonicMap, points: FloatArray) -> FloatArray:
    """Return the points at which one tile answers alone."""
    visits = field_map.learnt.tiling.by_tile(points)
    return np.asarray(points[np.concatenate([v.rows[v.share == 1] for v in visits])])


def test_within_a_tile_the_gradient_is_the_derivative_of_the_field(field_map: HarmonicMap) -> None:
    points = alone(field_map, within_survey(1000))
    assert len(points) > 50
    _, gradient = field_map.field_and_gradient(points)
    numeric = differences(field_map, points)
    # The step's square times a third derivative, about 1e-8 / 6 of 500 times the gradient beside
    # the post; rounding of 40 uT over the step is 1e-10.
    np.testing.assert_allclose(gradient, numeric, rtol=0, atol=2e-6 * np.abs(gradient).max())
    assert divergence_and_curl(numeric) < 2e-6


def test_between_tiles_the_field_has_the_gradient_to_its_own_sigma(field_map: HarmonicMap) -> None:
    """Blending adds the tiles' disagreement, a part of a sigma, over the width of the band."""
    points = within_survey(1000)
    _, gradient = field_map.field_and_gradient(points)
    seam = differences(field_map, points) - gradient
    sigma = rms(np.sqrt(field_map.variance(points)))
    assert np.abs(seam).max() > 0
    # A smooth step's slope is at most 1.9 of one over its width.
    assert rms(seam) < 0.6 * sigma * 1.9 / (2 * field_map.learnt.tiling.blend)


@settings(max_examples=20)
@given(
    place=st.tuples(*[st.floats(-1, 1)] * 3),
    moment=st.tuples(*[st.floats(-30, 30)] * 3),
    seed=st.integers(0, 100),
)
def test_a_dipole_is_its_closed_form(
    place: tuple[float, float, float], moment: tuple[float, float, float], seed: int
) -> None:
    """Moments in A m^2 against weights in uT m^3."""
    world = DipoleWorld(np.zeros(3), np.array([place]), np.array([moment]))
    family = Dipoles(np.array([place]), np.eye(3))
    directions = Rotation.random(30, rng=seed).apply([1.0, 0, 0])
    points = np.array(place) + directions * np.linspace(0.2, 3, 30)[:, None]
    weights = DIPOLE_CONSTANT * np.array(moment)
    ours, truth = family.field_and_gradient(points, weights), world.field_and_gradient(points)
    for one, other in zip(ours, truth, strict=True):
        # Powers of distances in another order: some digits of rounding.
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * (np.abs(other).max() + 1e-9))


BOX, K_MAX = 16.0, 18.0


@pytest.mark.parametrize(("side", "up"), [(FLOOR, 1.0), (CEILING, -1.0)])
def test_modes_of_a_large_box_have_the_covariance_of_the_closed_form(side: str, up: float) -> None:
    """Potential ``s^2 (2h)^3 / r`` with r = (dx, dy, z + z' + 2h), upside down for the ceiling.

    What the box changes are mirror images 16 m away: 8 s^2 (2h)^3 / 16^3, times 3 for the
    Hessian's largest entry, is 0.003 s^2. What the waves up to 18 / m leave out at h = 0.4 is
    exp(-14) of everything.
    """
    h = PRIOR.model_copy(update={f"{side}_scale": 2.0, f"{side}_depth": 0.4})
    modes = modes_up_to(side, np.full(2, BOX), 0.0, K_MAX)
    rng = np.random.default_rng(3)
    offsets = np.column_stack([rng.uniform(-0.7, 0.7, (8, 2)), up * rng.uniform(0, 0.5, 8)])
    points = np.array([BOX / 2, BOX / 2, 0]) + offsets
    variance = np.exp(modes.prior(h).log_variance)
    F = features(modes, points)
    phi = features(modes, points)[:, 2] / modes.kz  # dphi/dz = kz phi
    strength, r = 4.0 * 0.8**3, points[:, None] - points
    r[..., 2] = 0.8 + up * (points[:, None, 2] + points[:, 2])
    d = np.linalg.norm(r, axis=-1)[..., None, None]
    hessian = strength * (3 * r[..., :, None] * r[..., None, :] / d**5 - np.eye(3) / d**3)
    # Derivatives by the first place and by the second: opposite along x and y.
    signs = np.outer([1.0, 1.0, up], [-1.0, -1.0, up])
    field = np.einsum("nim,pjm,m->npij", F, F, variance)
    np.testing.assert_allclose(field, hessian * signs, rtol=0, atol=0.004 * 4.0)
    # The potential itself lacks a constant in a box; its differences do not.
    K, mode_sum = strength / d[..., 0, 0], (phi * variance) @ phi.T
    for covariance in (K, mode_sum):
        own = np.diag(covariance)
        covariance -= 0.5 * (own[:, None] + own)
    np.testing.assert_allclose(mode_sum, K, rtol=0, atol=0.004 * 4.0)


def test_the_prior_of_modes_at_the_lowest_reading_is_the_documented_scale() -> None:
    modes = modes_up_to(FLOOR, np.full(2, BOX), 0.0, K_MAX)
    middle = np.array([[BOX / 2 + 0.3, BOX / 2 - 0.2, 0.0]])
    h = PRIOR.model_copy(update={"floor_scale": 3.0, "floor_depth": 0.4})
    F = features(modes, middle)[0]
    sigma = np.sqrt(F**2 @ np.exp(modes.prior(h).log_variance))
    # Mirror images as above.
    np.testing.assert_allclose(sigma, [3.0, 3.0, 3.0 * np.sqrt(2)], rtol=0.005)


def test_a_uniform_field_changes_only_the_mean(field_map: HarmonicMap) -> None:
    """The prior of 100 uT holds back the variance of the uniform weight over 1e4 uT^2."""
    points, field = readings_at_a_post()
    uniform = np.array([60.0, -35.0, 20.0])
    added = HarmonicMap.fit(points, field + uniform, OPTIONS, POST)
    at = within_survey(100)
    one, other = field_map.query(at), added.query(at)
    # 60 uT times the posterior covariance of the field (0.03 uT) with the uniform weight (0.5 uT)
    # over 1e4 uT^2: 1e-4 at most.
    np.testing.assert_allclose(other.field - uniform, one.field, rtol=0, atol=1e-4)
    np.testing.assert_allclose(other.gradient, one.gradient, rtol=0, atol=1e-3)
    # The strength of the post is searched for anew, and the search ends where that is flat.
    np.testing.assert_allclose(other.variance, one.variance, rtol=1e-4)
    np.testing.assert_array_equal(other.inside, one.inside)


def test_one_height_tells_of_others() -> None:
    """The vertical gradient follows from the horizontal ones; independent axes know nothing."""
    points, strong = (
        survey_points(1000, 0.5, 0.5, seed=4),
        replace(WORLD, moments=5 * WORLD.moments),
    )
    field = strong.field_and_gradient(points)[0] + noise(1000)
    given = PRIOR.model_copy(update={"floor_scale": 8.0, "ceiling_scale": 2.5})
    options = OPTIONS.model_copy(update={"hyperparameters": given})
    ours, sliding = HarmonicMap.fit(points, field, options), SlidingGP.fit(points, field)
    at = within_survey(300, 0.7, 0.7) * [0.7, 0.7, 1]
    truth, _ = strong.field_and_gradient(at)
    error, theirs = ours.query(at).field - truth, sliding.field_and_gradient(at)[0] - truth
    assert rms(error) < 0.2 * rms(theirs)
    assert 0.5 < rms(error / np.sqrt(ours.variance(at))) < 1.5
    _, slope = strong.field_and_gradient(at - [0, 0, 0.2])
    _, known = ours.field_and_gradient(at - [0, 0, 0.2])
    _, nothing = sliding.field_and_gradient(at - [0, 0, 0.2])
    assert rms(nothing[:, :, 2]) < 1e-9
    assert rms((known - slope)[:, :, 2]) < 0.3 * rms(slope[:, :, 2])


TILT = Rotation.from_euler("xy", [4.0, -2.0], degrees=True)


def test_a_tilted_floor_turns_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles follow the plane of their readings: the tilted map is the level one, turned."""
    flat = survey_points(800, 0.5, 0.5, seed=5)
    flat[:, 2] += np.random.default_rng(5).normal(0, 0.005, 800)
    field = WORLD.field_and_gradient(flat)[0] + noise(800)
    level = HarmonicMap.fit(flat, field, OPTIONS)
    tilted = HarmonicMap.fit(TILT.apply(flat), TILT.apply(field), OPTIONS)
    up = np.stack([tile.basis.frame.R_map_tile[:, 2] for tile in tilted.tiles])
    # A plane through the 5 mm unevenness of a strip half a metre wide.
    np.testing.assert_allclose(up, np.tile(TILT.apply([0, 0, 1]), (len(up), 1)), atol=0.01)
    at = within_survey(300, 0.4, 0.7)
    here, there = level.query(at), tilted.query(TILT.apply(at))
    both = here.inside & there.inside
    assert both.mean() > 0.95
    sigma = np.sqrt(here.variance[both])
    back = TILT.inv().apply(there.field[both])
    # Boxes and cubes of averaging lie elsewhere: a part of a sigma.
    assert rms((back - here.field[both]) / sigma) < 0.4
    R = TILT.as_matrix()
    slope = R.T @ there.gradient[both] @ R
    assert rms(slope - here.gradient[both]) < 0.2 * rms(here.gradient[both])
    # Turned by four degrees the axes' variances mix by less than a hundredth.
    assert np.median(np.sqrt(there.variance[both]) / sigma) == pytest.approx(1.0, abs=0.1)
    monkeypatch.setattr(frame, "LEAST_SLOPE", np.inf)
    ignored = HarmonicMap.fit(TILT.apply(flat), TILT.apply(field), OPTIONS)
    np.testing.assert_array_equal(ignored.tiles[0].basis.frame.R_map_tile, np.eye(3))


def test_a_moved_world_has_a_moved_map() -> None:
    points, field = readings(300)
    move = 0.15 * np.array([200, -113, 17])  # the surveyed area is counted in cells of this size
    at = within_survey(50)
    here = HarmonicMap.fit(points, field, KEEP_ALL).query(at)
    there = HarmonicMap.fit(points + move, field, KEEP_ALL).query(at + move)
    # Positions of up to 30 m have digits of 4e-15 m; a condition of 1e6 leaves 1e-8.
    np.testing.assert_allclose(there.field, here.field, rtol=0, atol=1e-7)
    np.testing.assert_allclose(there.gradient, here.gradient, rtol=0, atol=1e-6)
    np.testing.assert_allclose(there.variance, here.variance, rtol=1e-6)


def test_more_readings_never_make_a_map_less_certain() -> None:
    """With given hyperparameters, which all tiles share.

    Where those of a tile follow its readings, new ones may show a stronger field than the old.
    """
    points, field = readings()
    few = HarmonicMap.fit(points, field, KEEP_ALL)
    at = within_survey()
    more = few.updated(points[:200] + 1e-3, field[:200])
    ratio = more.variance(at) / few.variance(at)
    # Only a tile whose plane changes with its readings could say otherwise; these are level.
    assert (ratio < 1 + 1e-9).all()
    assert np.median(ratio) < 0.95
