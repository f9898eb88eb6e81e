"""The parts that a harmonic map is made of, each against a slow or closed reference."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic import structure
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.dipoles import Dipoles, moment_features
from l2m_gtsam.maps.harmonic.evidence import (
    Evidence,
    Normal,
    condition,
    evidence,
    marginalised,
    normal_of,
)
from l2m_gtsam.maps.harmonic.family import Family
from l2m_gtsam.maps.harmonic.frame import TileFrame, tile_frame
from l2m_gtsam.maps.harmonic.furnish import FINE, basis_of, dipoles_of
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, Modes, left_out, modes_up_to
from l2m_gtsam.maps.harmonic.strengths import learn_strengths
from l2m_gtsam.maps.harmonic.structure import (
    NO_SOURCES,
    Sources,
    StructureOptions,
    candidate_sources,
)
from l2m_gtsam.maps.harmonic.tiling import (
    WAVE_NUMBERS,
    Resolution,
    Tiling,
    TilingOptions,
    resolution_of,
    tiling_of,
)
from l2m_gtsam.maps.harmonic.uniform import UniformField
from l2m_gtsam.maps.training import TrainingSet, training_set

GIVEN = Hyperparameters(
    floor_scale=3.0,
    floor_depth=0.5,
    ceiling_scale=1.5,
    ceiling_depth=1.2,
    structure_scale=0.4,
    noise=0.2,
)
SIZE = np.array([3.0, 2.5])
TILTED = Rotation.from_euler("xyz", [5.0, -3.0, 20.0], degrees=True).as_matrix()


def places(count: int = 40, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform([0.2, 0.2, 0.0], [2.8, 2.3, 0.8], (count, 3))


def dipoles() -> Dipoles:
    rng = np.random.default_rng(1)
    combinations, _ = np.linalg.qr(rng.normal(size=(6, 4)))
    return Dipoles(np.array([[1.0, 1.0, -0.4], [1.5, -0.5, 0.5]]), combinations, 2.0)


FAMILIES: dict[str, Family] = {
    "uniform": UniformField(100.0),
    "floor": modes_up_to(FLOOR, SIZE, 0.0, 5.0),
    "ceiling": modes_up_to(CEILING, SIZE, 0.8, 4.0),
    "dipoles": dipoles(),
}
EACH_FAMILY = pytest.mark.parametrize("name", list(FAMILIES))


def weights_for(family: Family | Basis) -> FloatArray:
    return np.random.default_rng(2).normal(size=len(family))


def basis(R: FloatArray = TILTED) -> Basis:
    frame = TileFrame(R, np.array([10.0, -20.0, 0.3]), SIZE, 0.8)
    return Basis(frame, tuple(FAMILIES.values()))


def slopes(of: Callable[[FloatArray], FloatArray], points: FloatArray, step: float) -> FloatArray:
    """Derivatives along x, y and z by central differences, the axis last."""
    return np.stack(
        [(of(points + step * e) - of(points - step * e)) / (2 * step) for e in np.eye(3)], axis=-1
    )


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
    assert_derivative(field, slopes(lambda x: family.potential(x, w), places(), 1e-4))
    numeric = slopes(lambda x: family.field_and_gradient(x, w)[0], places(), 1e-4)
    np.testing.assert_allclose(gradient, numeric, rtol=0, atol=2e-6 * (1 + np.abs(gradient).max()))


@EACH_FAMILY
def test_features_times_weights_are_the_field(name: str) -> None:
    family = FAMILIES[name]
    w = weights_for(family)
    field, _ = family.field_and_gradient(places(), w)
    # The same sums in another order.
    scale = np.abs(field).max()
    np.testing.assert_allclose(family.features(places()) @ w, field, rtol=0, atol=1e-12 * scale)


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
    flat = modes.potential(nodes.reshape(-1, 3), w).reshape(5, 4, 3)
    np.testing.assert_allclose(modes.potential_on(x, y, z, w), flat, rtol=0, atol=1e-12)


def test_a_basis_turns_its_families_into_the_map_frame() -> None:
    tilted = basis()
    w, frame = weights_for(tilted), tilted.frame
    points = places() @ TILTED.T + frame.corner
    np.testing.assert_allclose(frame.localise(points), places(), rtol=0, atol=1e-13)
    field, gradient = tilted.field_and_gradient(points, w)
    assert_derivative(field, slopes(lambda x: tilted.potential(x, w), points, 1e-4))
    numeric = slopes(lambda x: tilted.field_and_gradient(x, w)[0], points, 1e-4)
    np.testing.assert_allclose(gradient, numeric, rtol=0, atol=2e-6 * np.abs(gradient).max())
    scale = np.abs(field).max()
    np.testing.assert_allclose(tilted.features(points) @ w, field, rtol=0, atol=1e-12 * scale)


def test_batches_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    tilted, points = basis(), places(50)
    w = weights_for(tilted)
    one = (*tilted.field_and_gradient(points, w), tilted.potential(points, w))
    monkeypatch.setattr("l2m_gtsam.maps.harmonic.basis.BATCH", 7)
    other = (*tilted.field_and_gradient(points, w), tilted.potential(points, w))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(a).max())


def survey(count: int = 60, seed: int = 3) -> TrainingSet:
    """Readings drawn from the prior of ``basis``, of different weights."""
    rng = np.random.default_rng(seed)
    model = basis()
    points = places(count, seed) @ TILTED.T + model.frame.corner
    weight = rng.uniform(0.5, 4.0, count)
    w = np.exp(0.5 * model.prior(GIVEN).log_variance) * rng.normal(size=len(model))
    noise = GIVEN.noise * rng.normal(size=(count, 3)) / np.sqrt(weight)[:, None]
    return training_set(points, model.features(points) @ w + noise, weight)


def dense_covariance(readings: TrainingSet, log_variance: FloatArray, noise: float) -> FloatArray:
    """Covariance of all readings, shape (3 N, 3 N)."""
    F = basis().features(readings.points).reshape(-1, len(basis()))
    own = np.repeat(noise**2 / readings.weight, 3)
    return np.asarray((F * np.exp(log_variance)) @ F.T + np.diag(own))


def evidence_at(log_variance: FloatArray, log_noise: float) -> Evidence:
    return evidence(normal_of(basis(), survey()), log_variance, float(np.exp(log_noise)))


def test_the_evidence_is_the_gaussian_density_of_the_readings() -> None:
    readings, log_variance = survey(), basis().prior(GIVEN).log_variance
    for noise in (0.05, GIVEN.noise, 1.0):
        dense = dense_covariance(readings, log_variance, noise)
        expected = multivariate_normal.logpdf(readings.field.ravel(), cov=dense)
        # Condition 1e8 (100 uT against 0.05) of sums that are of order 1e3.
        assert evidence_at(log_variance, np.log(noise)).value == pytest.approx(expected, rel=1e-7)


def test_slopes_of_the_evidence_are_its_derivatives() -> None:
    log_variance, log_noise = basis().prior(GIVEN).log_variance, float(np.log(GIVEN.noise))
    ours = evidence_at(log_variance, log_noise)
    # The field's square over the noise's, 5e7, ends in digits of 1e-8: 1e-5 of a slope. Third
    # derivatives of a few units times the step's square are less.
    step, tolerance = 1e-3, 1e-4
    for column, unit in enumerate(np.eye(len(log_variance))):
        up, down = (evidence_at(log_variance + s * unit, log_noise).value for s in (step, -step))
        slope = (up - down) / (2 * step)
        assert ours.by_log_variance[column] == pytest.approx(slope, abs=tolerance)
    up, down = (evidence_at(log_variance, log_noise + s).value for s in (step, -step))
    assert ours.by_log_noise == pytest.approx((up - down) / (2 * step), rel=tolerance)


def test_the_posterior_is_that_of_the_dense_process() -> None:
    readings, model = survey(), basis()
    log_variance = model.prior(GIVEN).log_variance
    ours = condition(normal_of(model, readings), log_variance, GIVEN.noise)
    at = places(15, seed=8) @ TILTED.T + model.frame.corner
    F_at = model.features(at).reshape(-1, len(model))
    F = model.features(readings.points).reshape(-1, len(model))
    cross = (F_at * np.exp(log_variance)) @ F.T
    solved = np.linalg.solve(dense_covariance(readings, log_variance, GIVEN.noise), cross.T)
    mean, covariance = solved.T @ readings.field.ravel(), -cross @ solved
    covariance += (F_at * np.exp(log_variance)) @ F_at.T
    L = ours.root
    # Condition 1e6 (100 uT against 0.1) of numbers up to 100 (mean) and 1e4 (prior covariance).
    np.testing.assert_allclose(F_at @ ours.mean, mean, rtol=0, atol=1e-8)
    np.testing.assert_allclose(F_at @ L @ L.T @ F_at.T, covariance, rtol=0, atol=1e-7)


def test_weights_that_are_integrated_out_leave_the_same_slopes() -> None:
    readings, model = survey(), basis()
    normal, log_variance = normal_of(model, readings), model.prior(GIVEN).log_variance
    kept = np.arange(len(model) - 4, len(model))
    alone = marginalised(normal, kept, log_variance, GIVEN.noise)
    steps = np.array([-2.0, 0.0, 1.0])
    values = []
    for step in steps:
        moved = log_variance.copy()
        moved[kept] += step
        whole = evidence(normal, moved, GIVEN.noise)
        part = evidence(alone, moved[kept], GIVEN.noise)
        # Condition 1e6 of slopes of order one.
        np.testing.assert_allclose(
            part.by_log_variance, whole.by_log_variance[kept], rtol=0, atol=1e-6
        )
        values.append(whole.value - part.value)
    np.testing.assert_allclose(values, values[0], rtol=0, atol=1e-5)


def assert_same_sums(one: Normal, other: Normal) -> None:
    # Sums of the same numbers in another order, differences of them at worst.
    np.testing.assert_allclose(one.FF, other.FF, rtol=0, atol=1e-12 * np.abs(other.FF).max())
    np.testing.assert_allclose(one.Fy, other.Fy, rtol=0, atol=1e-11 * np.abs(other.Fy).max())
    assert one.yy == pytest.approx(other.yy, rel=1e-11)
    assert one.rows == other.rows
    assert one.log_weight == pytest.approx(other.log_weight, abs=1e-11)


@settings(max_examples=10, deadline=None)
@given(cut=st.integers(1, 59), seed=st.integers(0, 100))
def test_sums_over_readings_add_and_subtract(cut: int, seed: int) -> None:
    rows = np.random.default_rng(seed).permutation(60)
    model, readings = basis(), survey()
    first, second = (normal_of(model, readings[part]) for part in (rows[:cut], rows[cut:]))
    assert_same_sums(first + second, normal_of(model, readings))
    assert_same_sums((first + second) - first, second)


def test_a_reading_of_weight_two_is_two_readings() -> None:
    readings, model = survey(), basis()
    twice = training_set(
        np.repeat(readings.points, 2, axis=0), np.repeat(readings.field, 2, axis=0)
    )
    once = training_set(readings.points, readings.field, np.full(60, 2.0))
    one, other = normal_of(model, once), normal_of(model, twice)
    np.testing.assert_allclose(one.FF, other.FF, rtol=0, atol=1e-12 * np.abs(one.FF).max())
    np.testing.assert_allclose(one.Fy, other.Fy, rtol=0, atol=1e-12 * np.abs(one.Fy).max())


def test_weights_known_far_better_than_the_prior_are_no_trouble() -> None:
    """Whitened information of 1e17: the factor must exist and the mean must fit the readings."""
    readings, model = survey(), basis()
    wide = np.full(len(model), np.log(1e16))
    ours = condition(normal_of(model, readings), wide, 1e-3)
    fit = model.features(readings.points) @ ours.mean
    assert np.isfinite(fit).all()
    # Ordinary least squares of noise 0.2 on weight one or so.
    assert np.sqrt(np.mean((fit - readings.field) ** 2)) < 0.3


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
        F = modes.features(np.column_stack([xy, np.full(150, height)]))
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


POSITIVE = st.floats(0.05, 20.0)


@settings(max_examples=100, deadline=None)
@given(scale=POSITIVE, depth=st.floats(0.05, 5.0), density=st.floats(0.5, 1000), noise=POSITIVE)
def test_the_resolution_is_where_readings_tell_the_share(
    scale: float, depth: float, density: float, noise: float
) -> None:
    """Against the docstring's ratio on a fine grid of wave numbers."""
    h = GIVEN.model_copy(update={"floor_scale": scale, "floor_depth": depth, "noise": noise})
    share = 0.05
    found = resolution_of(h, density, share).floor
    low, high = WAVE_NUMBERS

    def ratio(k: float | FloatArray) -> FloatArray:
        spectrum = k * np.exp(-2 * k * depth) * (2 * depth) ** 3
        return np.asarray(4 * np.pi * scale**2 * spectrum * density / noise**2)

    beyond = np.linspace(found, high, 2000)[1:]
    assert low <= found <= high
    assert found == high or (ratio(beyond) < share).all()
    if low < found < high:
        assert ratio(found) == pytest.approx(share, rel=1e-6)


@settings(max_examples=50, deadline=None)
@given(scale=POSITIVE, depth=st.floats(0.05, 5.0), density=st.floats(0.5, 1000), noise=POSITIVE)
def test_better_surveys_never_resolve_less(
    scale: float, depth: float, density: float, noise: float
) -> None:
    h = GIVEN.model_copy(update={"floor_scale": scale, "floor_depth": depth, "noise": noise})
    once = resolution_of(h, density, 0.05).floor
    assert resolution_of(h, 2 * density, 0.05).floor >= once
    assert resolution_of(h, density, 0.02).floor >= once
    louder = h.model_copy(update={"noise": 2 * noise})
    assert resolution_of(louder, density, 0.05).floor <= once
    stronger = h.model_copy(update={"floor_scale": 2 * scale})
    assert resolution_of(stronger, density, 0.05).floor >= once


def test_readings_tell_of_a_mode_what_the_resolution_assumes() -> None:
    """4 pi s^2 (2h)^3 k exp(-2kh) density / sigma^2 against the normal matrix of readings."""
    edge, count = 6.0, 4000
    xy = np.random.default_rng(5).uniform(0, edge, (count, 2))
    F = modes_up_to(FLOOR, np.full(2, edge), 0.0, 5.0)
    features = F.features(np.column_stack([xy, np.zeros(count)]))
    information = np.einsum("nim,nim->m", features, features) / GIVEN.noise**2
    k, h = np.abs(F.kz), GIVEN.floor_depth
    both = (F.numbers > 0).all(axis=1)
    ratio = np.exp(F.prior(GIVEN).log_variance) * information
    formula = 4 * np.pi * GIVEN.floor_scale**2 * (2 * h) ** 3 * k * np.exp(-2 * k * h)
    formula *= count / edge**2 / GIVEN.noise**2
    # Random places average a wave's square to 1 / sqrt(4000): 2 %, of 60 modes the worst 6 %.
    np.testing.assert_allclose(ratio[both], formula[both], rtol=0.1)


AREA = np.random.default_rng(6).uniform([-3, -2, 0.3], [9, 7, 0.9], (2000, 3))


@settings(max_examples=30, deadline=None)
@given(k=st.floats(2.0, 12.0), budget=st.integers(50, 2000))
def test_tiles_share_every_place_of_the_survey(k: float, budget: int) -> None:
    tiling = tiling_of(AREA, Resolution(k, 0.5 * k), TilingOptions(), budget, reach=0.5)
    total = sum(tiling.shares(AREA, tile) for tile in range(len(tiling)))
    # A polynomial and its mirror image sum to one to rounding.
    np.testing.assert_allclose(total, 1.0, rtol=0, atol=1e-12)
    assert all(len(rows) for rows in tiling.grid.members(AREA, tiling.overlap))


def test_tiles_are_as_large_as_their_budget() -> None:
    resolution, options = Resolution(6.0, 3.0), TilingOptions()
    tiling = tiling_of(AREA, resolution, options, 500, reach=0.5)
    assert resolution.modes(tiling.edge) <= 500
    counted = sum(
        len(modes_up_to(side, np.full(2, tiling.edge), 0.0, k))
        for side, k in ((FLOOR, 6.0), (CEILING, 3.0))
    )
    # A quarter of a disc of half waves; the modes along its straight sides come on top.
    assert counted == pytest.approx(resolution.modes(tiling.edge), rel=0.25)


def share_profile(tiling: Tiling, x: FloatArray) -> FloatArray:
    centre = tiling.grid.centres[0]
    points = np.column_stack([centre[0] + x, np.full(len(x), centre[1]), np.zeros(len(x))])
    return tiling.shares(points, 0)


def test_shares_fade_without_a_step_or_a_kink() -> None:
    tiling = tiling_of(AREA, Resolution(6.0, 3.0), TilingOptions(), 500, reach=0.5)
    x = np.linspace(0, tiling.grid.size, 4001)
    share = share_profile(tiling, x)
    edge, blend = 0.5 * tiling.grid.size, tiling.blend
    assert (share[x < edge - blend] == 1).all()
    assert (share[x > edge + blend] == 0).all()
    assert (np.diff(share) <= 0).all()
    step = x[1]
    # The smooth step of width w has slopes up to 1.9 / w, curvatures up to 5.8 / w^2, and third
    # derivatives up to 60 / w^3: nothing jumps by more than a step's worth of the next one.
    width = 2 * blend
    assert np.abs(np.diff(share)).max() < 2 * step / width
    assert np.abs(np.diff(share, 2)).max() < 6 * (step / width) ** 2
    assert np.abs(np.diff(share, 3)).max() < 61 * (step / width) ** 3


DRIVE = np.column_stack(
    [np.linspace(0, 6, 120), np.zeros(120), np.where(np.arange(120) % 2, 0.4, 0.8)]
)
VOXELS = StructureOptions()


def column(x: float, y: float, low: float, high: float) -> FloatArray:
    z = np.arange(low, high, 0.05)
    return np.column_stack([np.full(len(z), x), np.full(len(z), y), z])


def floor_points() -> FloatArray:
    x, y = np.meshgrid(np.arange(-1, 7, 0.1), np.arange(-1.5, 1.5, 0.1))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def test_a_bare_floor_makes_no_sources() -> None:
    assert len(candidate_sources(floor_points(), DRIVE, VOXELS)) == 0


def test_no_cloud_makes_no_sources() -> None:
    assert len(candidate_sources(np.empty((0, 3)), DRIVE, VOXELS)) == 0


def test_a_post_makes_sources_along_itself() -> None:
    post = column(3.0, 0.7, 0.0, 1.5)
    found = candidate_sources(np.concatenate([floor_points(), post]), DRIVE, VOXELS)
    half = VOXELS.edge / 2
    assert (np.abs(found.positions[:, :2] - [3.0, 0.7]) <= half + 1e-9).all()
    # From half a metre below the lowest reading, here the floor, to its top: one per voxel.
    occupied = np.unique(np.floor(post[:, 2] / VOXELS.edge))
    occupied = occupied[(occupied + 0.5) * VOXELS.edge >= 0.4 - VOXELS.below]
    assert len(found) == len(occupied)
    assert (found.structure == 0).all()


def test_structure_under_the_drive_is_followed_only_so_far() -> None:
    deep = candidate_sources(column(3.0, 0.7, -1.5, 1.5), DRIVE, VOXELS)
    assert deep.positions[:, 2].min() >= 0.4 - VOXELS.below
    assert deep.positions[:, 2].min() < 0.4 - VOXELS.below + VOXELS.edge


def test_structure_below_the_drive_alone_is_the_floors() -> None:
    assert len(candidate_sources(column(3.0, 0.7, 0.0, 0.3), DRIVE, VOXELS)) == 0


def test_no_source_is_out_of_reach_or_where_the_sensor_was() -> None:
    rng = np.random.default_rng(7)
    cloud = rng.uniform([-4, -4, -1], [10, 4, 4], (20_000, 3))
    found = candidate_sources(cloud, DRIVE, VOXELS)
    away = np.linalg.norm(found.positions[:, None] - DRIVE, axis=2).min(axis=1)
    assert len(found) > 100
    assert away.max() <= VOXELS.reach
    assert away.min() >= VOXELS.clearance


def test_pieces_are_touching_voxels_of_one_cell() -> None:
    wall = np.concatenate([column(x, 0.7, 0.2, 1.2) for x in np.arange(0.06, 3.9, 0.05)])
    lone = column(5.5, -0.7, 0.2, 1.2)
    found = candidate_sources(np.concatenate([wall, lone]), DRIVE, VOXELS)
    parts = found.pieces
    assert sum(len(part) for part in parts) == len(found)
    assert len(parts) == 5  # four metres of wall and a post
    for part in parts:
        assert len(np.unique(part.structure)) == 1
        assert (np.ptp(part.positions[:, :2], axis=0) <= VOXELS.piece).all()
    np.testing.assert_array_equal(np.unique(found.structure), np.arange(5))


def test_two_posts_of_one_cell_are_two_structures() -> None:
    posts = np.concatenate([column(3.2, 0.7, 0.2, 1.2), column(3.7, 0.7, 0.2, 1.2)])
    assert len(candidate_sources(posts, DRIVE, VOXELS).pieces) == 2


def test_too_many_sources_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure, "MOST_SOURCES", 5)
    with pytest.raises(MapError, match=r"suggests 1\d sources .* at most 5 .* structure.edge"):
        candidate_sources(column(3.0, 0.7, 0.0, 1.5), DRIVE, VOXELS)


def test_structures_stand_in_the_tile_that_holds_their_middle() -> None:
    positions = np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.2, 0, 0]])
    sources = Sources(positions, np.array([0, 0, 1, 1]))
    assert sources.within(np.zeros(2), 1.2) == [0]
    assert sources.within(np.array([2.0, 0.0]), 4.0) == [0, 1]
    assert sources.within(np.array([9.0, 0.0]), 1.0) == []
    assert NO_SOURCES.within(np.zeros(2), 1.0) == []


def sparse_post(x: float) -> FloatArray:
    """Six sources one above the other, 12 cm apart."""
    return np.column_stack([np.full(6, x), np.zeros(6), 0.2 + 0.12 * np.arange(6)])


def test_combinations_leave_out_only_what_no_reading_sees() -> None:
    """Sources 4 cm apart, seen from half a metre and more: fewer weights, the same field."""
    rng = np.random.default_rng(8)
    dense = column(0.0, 0.0, 0.2, 0.8)
    sources = Sources(dense, np.zeros(len(dense), dtype=np.int64))
    angle = rng.uniform(0, 2 * np.pi, 300)
    ring = rng.uniform(0.5, 1.5, 300) * np.stack([np.cos(angle), np.sin(angle)])
    points = np.column_stack([*ring, rng.uniform(0.2, 0.9, 300)])
    frame = tile_frame(points, np.zeros(2), 4.0)
    seen = dipoles_of(sources, training_set(points, np.zeros((300, 3))), frame, 1.5, FINE)
    count = 3 * len(dense)
    assert len(seen) < 0.8 * count
    gram = seen.combinations.T @ seen.combinations
    np.testing.assert_allclose(gram, np.eye(len(seen)), atol=1e-12)
    local, moments = frame.localise(points), rng.normal(size=count)
    field = moment_features(local, seen.positions) @ moments
    kept = seen.features(local) @ (seen.combinations.T @ moments)
    # Each combination that is left out holds less than FINE of the best one's energy, and the
    # best of so many holds more than its share of the field's.
    assert np.sum((field - kept) ** 2) < FINE * count**2 * np.sum(field**2)


def two_posts(moments: FloatArray) -> tuple[TrainingSet, Sources]:
    """Readings around two posts at x = -1 and 1, the first with moments (6, 3)."""
    rng = np.random.default_rng(9)
    posts = [sparse_post(x) for x in (-1.0, 1.0)]
    sources = Sources(np.concatenate(posts), np.repeat([0, 1], 6))
    points = rng.uniform([-2, -1.2, 0.3], [2, 1.2, 0.8], (900, 3))
    points = points[np.abs(points[:, 1]) > 0.3]
    field = moment_features(points, posts[0]) @ moments.ravel()
    return training_set(points, field + rng.normal(0, GIVEN.noise, points.shape)), sources


def learnt_strengths(readings: TrainingSet, sources: Sources) -> list[float]:
    resolution = Resolution(3.0, 2.0)
    quiet = GIVEN.model_copy(update={"floor_scale": 0.1, "ceiling_scale": 0.1})
    model = basis_of(readings, np.zeros(2), 5.0, resolution, sources.pieces, np.ones(2))
    return learn_strengths(model, normal_of(model, readings), quiet)


def test_only_structures_with_a_field_have_strength() -> None:
    moments = np.random.default_rng(10).normal(0, 0.8, (6, 3))
    steel, timber = learnt_strengths(*two_posts(moments))
    # The prior scale is 0.4: strength 2 for moments of 0.8; the three or so combinations that
    # readings determine well say it within a factor of two or three.
    assert 0.6 < steel < 6
    assert timber == 0.0


def test_no_field_no_strength() -> None:
    assert learnt_strengths(*two_posts(np.zeros((6, 3)))) == [0.0, 0.0]


def test_strengths_do_not_depend_on_where_the_search_starts() -> None:
    readings, sources = two_posts(np.random.default_rng(11).normal(0, 0.5, (6, 3)))
    model = basis_of(
        readings, np.zeros(2), 5.0, Resolution(3.0, 2.0), sources.pieces, np.full(2, 0.2)
    )
    quiet = GIVEN.model_copy(update={"floor_scale": 0.1, "ceiling_scale": 0.1})
    elsewhere = learn_strengths(model, normal_of(model, readings), quiet)
    here = learnt_strengths(readings, sources)
    # Both searches end where the likelihood is flat to 1e-9 of itself.
    np.testing.assert_allclose(elsewhere, here, rtol=0.02)


@pytest.mark.parametrize("degrees", [0.0, 0.5, 3.0, 10.0])
def test_a_tile_follows_a_tilted_plane(degrees: float) -> None:
    rng = np.random.default_rng(12)
    flat = np.column_stack([rng.uniform(-2, 2, (500, 2)), rng.normal(0, 0.01, 500)])
    R = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    frame = tile_frame(flat @ R.T, np.zeros(2), 6.0)
    axes = frame.R_map_tile
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    local = frame.localise(flat @ R.T)
    assert local[:, 2].min() == pytest.approx(0, abs=1e-12)
    assert local[:, 2].max() == pytest.approx(frame.height, abs=1e-12)
    # Below LEAST_SLOPE, 1.1 degrees, it stays level; 500 heights of 1 cm tell it to 0.02.
    tilt = np.degrees(np.arccos(axes[2, 2]))
    assert tilt == pytest.approx(degrees if degrees > 1.2 else 0.0, abs=0.1)


def test_heights_that_follow_no_plane_leave_a_tile_level() -> None:
    rng = np.random.default_rng(13)
    points = np.column_stack([rng.uniform(-2, 2, (500, 2)), rng.choice([0.3, 0.6, 0.9], 500)])
    np.testing.assert_array_equal(tile_frame(points, np.zeros(2), 6.0).R_map_tile, np.eye(3))


def two_lanes() -> FloatArray:
    """Side by side at two heights."""
    x = np.linspace(-2, 2, 80)
    return np.column_stack([x, np.repeat([0.0, 0.4], 40), np.repeat([0.4, 0.7], 40)])


FEW = np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.5], [0.0, 0.1, 0.8]])


@pytest.mark.parametrize("points", [FEW, two_lanes()], ids=["few", "lanes"])
def test_a_plane_as_steep_as_no_floor_leaves_a_tile_level(points: FloatArray) -> None:
    """37 and 80 degrees; vehicles drive on ramps of up to fifteen."""
    np.testing.assert_array_equal(tile_frame(points, np.zeros(2), 4.0).R_map_tile, np.eye(3))


def test_a_damped_weight_keeps_its_prior() -> None:
    """Without readings nearby the posterior of a weight is its prior."""
    readings, model = survey(), basis()
    far = replace(readings, points=readings.points + 1e3 * TILTED[:, 2])
    floor = slice(3, 3 + len(FAMILIES["floor"]))
    silent = Basis(model.frame, (model.families[0], model.families[1]))
    assume_prior = silent.prior(GIVEN).log_variance
    ours = condition(normal_of(silent, far), assume_prior, GIVEN.noise)
    L = ours.root
    np.testing.assert_allclose(
        np.diag(L @ L.T)[floor], np.exp(assume_prior)[floor], rtol=1e-9
    )  # exp(-1000 k) of a mode is left there
