"""What physics and statistics demand of a map, whatever its code."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters, KernelLearningOptions, learn
from l2m_gtsam.maps.sliding_gp import SlidingGP
from l2m_gtsam.maps.training import ThinningOptions, training_set
from tests.worlds.exact import DipoleWorld, dipole_world

GIVEN = KernelHyperparameters(length_scale=0.8, signal=4.0, noise=0.2)
KINDS = pytest.mark.parametrize("kind", ["sliding_gp", "dense_gp"])
ANY_KIND = st.sampled_from(["sliding_gp", "dense_gp"])


def exact_options(kind: str) -> MapOptions:
    """Fixed hyperparameters, every reading kept, blocks that see all data."""
    fixed = {"hyperparameters": GIVEN, "thinning": {"spacing": 0}}
    sliding = {**fixed, "margin": 10}
    return MapOptions.model_validate({"kind": kind, "sliding_gp": sliding, "dense_gp": fixed})


def readings(seed: int, count: int = 150) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -2, 0.2], [2, 2, 0.8], (count, 3))
    field, _ = dipole_world(1).field_and_gradient(points)
    return points, field + rng.normal(0, GIVEN.noise, field.shape)


def queries(seed: int, count: int = 60) -> FloatArray:
    return np.random.default_rng(seed).uniform([-2.5, -2.5, 0], [2.5, 2.5, 1], (count, 3))


def smooth(field_map: FieldMap, points: FloatArray) -> FieldSample:
    """What a map says also outside."""
    field, gradient = field_map.field_and_gradient(points)
    inside = field_map.query(points).inside
    return FieldSample(field, gradient, field_map.variance(points), inside)


def assert_close(one: FieldSample, other: FieldSample) -> None:
    # Condition 1e4 to 1e5 of the covariance times rounding of a field of 50 uT: 1e-10.
    for name in ("field", "gradient", "variance", "inside"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-8)


@settings(max_examples=15)
@given(kind=ANY_KIND, uniform=st.tuples(*[st.floats(-60, 60)] * 3), seed=st.integers(0, 1000))
def test_a_uniform_field_changes_only_the_mean(
    kind: str, uniform: tuple[float, float, float], seed: int
) -> None:
    points, field = readings(seed)
    without = smooth(build_map(points, field, exact_options(kind)), queries(seed))
    added = smooth(build_map(points, field + uniform, exact_options(kind)), queries(seed))
    shifted = FieldSample(
        without.field + uniform, without.gradient, without.variance, without.inside
    )
    assert_close(added, shifted)


@settings(max_examples=15)
@given(
    kind=ANY_KIND,
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    move=st.tuples(*[st.floats(-100, 100)] * 3),
    seed=st.integers(0, 1000),
)
def test_a_map_of_a_turned_and_moved_world_is_turned_and_moved(
    kind: str,
    turn: tuple[float, float, float],
    move: tuple[float, float, float],
    seed: int,
) -> None:
    R = Rotation.from_rotvec(turn).as_matrix()
    points, field = readings(seed)
    at = queries(seed)
    here = smooth(build_map(points, field, exact_options(kind)), at)
    there = smooth(
        build_map(points @ R.T + move, field @ R.T, exact_options(kind)), at @ R.T + move
    )
    turned = FieldSample(here.field @ R.T, R @ here.gradient @ R.T, here.variance, there.inside)
    assert_close(there, turned)
    # Only a query at the very edge of the reach may fall on the other side.
    assert np.count_nonzero(here.inside != there.inside) <= 1


@KINDS
def test_stronger_fields_and_noises_scale_the_map(kind: str) -> None:
    points, field = readings(0)
    options = exact_options(kind)
    stronger = KernelHyperparameters(length_scale=0.8, signal=12.0, noise=0.6)
    part = getattr(options, kind).model_copy(update={"hyperparameters": stronger})
    once = smooth(build_map(points, field, options), queries(0))
    thrice = smooth(
        build_map(points, 3 * field, options.model_copy(update={kind: part})), queries(0)
    )
    scaled = FieldSample(3 * once.field, 3 * once.gradient, 9 * once.variance, once.inside)
    assert_close(thrice, scaled)


@KINDS
def test_far_from_data_the_prior_comes_back(kind: str) -> None:
    points, field = readings(0)
    ours = build_map(points, field, exact_options(kind))
    far = 12 * GIVEN.length_scale * Rotation.random(20, rng=0).apply([1.0, 0, 0])
    at = far + np.sign(far) * [2, 2, 1]
    field_far, gradient_far = ours.field_and_gradient(at)
    # At 12 length scales the kernel is exp(-72).
    np.testing.assert_allclose(field_far, np.tile(field.mean(axis=0), (20, 1)), rtol=1e-12)
    np.testing.assert_allclose(gradient_far, 0, atol=1e-12)
    np.testing.assert_allclose(ours.variance(at), GIVEN.signal**2, rtol=1e-12)
    assert not ours.query(at).inside.any()


@settings(max_examples=15)
@given(kind=ANY_KIND, seed=st.integers(0, 1000))
def test_more_readings_never_make_a_map_less_certain(kind: str, seed: int) -> None:
    points, field = readings(seed)
    few = build_map(points[:100], field[:100], exact_options(kind)).variance(queries(seed))
    many = build_map(points, field, exact_options(kind)).variance(queries(seed))
    assert (few <= GIVEN.signal**2).all()
    assert (many >= 0).all()
    assert (many <= few + 1e-9).all()  # rounding at condition 1e5


@KINDS
def test_at_a_reading_the_variance_is_below_the_noise(kind: str) -> None:
    points, field = readings(0)
    variance = build_map(points, field, exact_options(kind)).variance(points)
    assert (variance < GIVEN.noise**2).all()


def drawn_world(seed: int) -> tuple[FloatArray, FloatArray]:
    """Points and the values there of a field that is the Gaussian process ``GIVEN``."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, 0.2], [3, 3, 0.8], (1100, 3))
    K = np.exp(-0.5 * cdist(points, points, "sqeuclidean") / GIVEN.length_scale**2)
    values, vectors = np.linalg.eigh(GIVEN.signal**2 * K)
    root = vectors * np.sqrt(np.maximum(values, 0))
    return points, np.array([20.0, 5, -40]) + root @ rng.normal(size=(1100, 3))


def test_sigmas_are_true_when_the_model_is() -> None:
    """Default options from a field of the assumed kind: learnt, thinned, in blocks."""
    squares, noises = [], []
    for seed in range(3):
        points, truth = drawn_world(seed)
        noise = np.random.default_rng(100 + seed).normal(0, GIVEN.noise, truth.shape)
        ours = SlidingGP.fit(points[:900], (truth + noise)[:900])
        sample = ours.query(points[900:])
        assert sample.inside.all()
        squares.append((sample.field - truth[900:]) ** 2 / sample.variance)
        noises.append(ours.trained.hyperparameters.noise)
    z2 = np.concatenate(squares)
    # 1,800 scores, of which neighbours are correlated: about 60 independent ones per axis and
    # world, 540 in all, whose mean square is within 3 sqrt(2 / 540) = 0.18 of one; learnt
    # hyperparameters and the averaging within cubes add up to a tenth.
    assert np.mean(z2) == pytest.approx(1, abs=0.3)
    assert np.mean(z2 < 1.96**2) == pytest.approx(0.95, abs=0.03)
    # Each world's noise is learnt to about 3 % of itself.
    assert np.mean(noises) == pytest.approx(GIVEN.noise, rel=0.1)


def survey(world: DipoleWorld, seed: int, noise: float) -> tuple[FloatArray, FloatArray]:
    """Three heights, three sensors abreast, lanes 1.5 m apart, a reading every 10 cm."""
    rng = np.random.default_rng(seed)
    x = np.arange(-3.5, 3.5, 0.1)
    lanes = np.arange(-3, 3.1, 1.5)[:, None] + np.array([-0.5, 0, 0.5])
    X, Y, Z = np.meshgrid(x, lanes.ravel(), [0.2, 0.5, 0.8], indexing="ij")
    points = np.column_stack([X.ravel(), Y.ravel(), Z.ravel()])
    points += rng.normal(0, 0.02, points.shape)
    return points, world.field_and_gradient(points)[0] + rng.normal(0, noise, points.shape)


def test_a_survey_of_dipoles_is_predicted_with_a_true_sigma() -> None:
    world = dipole_world(2)
    ours = SlidingGP.fit(*survey(world, 0, noise=0.1))
    at = np.random.default_rng(9).uniform([-3, -3, 0.2], [3, 3, 0.8], (1000, 3))
    sample, (truth, slope) = ours.query(at), world.field_and_gradient(at)
    assert sample.inside.all()
    spread = truth.std(axis=0).mean()
    error = sample.field - truth
    # Structure finer than the lanes is lost: 0.06 to 0.08 of the field's spread in three worlds,
    # and 0.21 to 0.25 of the gradient's.
    assert np.sqrt(np.mean(error**2)) < 0.1 * spread
    assert np.sqrt(np.mean((sample.gradient - slope) ** 2)) < 0.3 * slope.std()
    # A dipole field is not a stationary process: sigmas hold on average only.
    assert 0.6 < np.sqrt(np.mean(error**2 / sample.variance)) < 1.6


def test_two_surveys_of_one_world_agree_within_their_sigmas() -> None:
    world = dipole_world(3)
    one, other = (SlidingGP.fit(*survey(world, seed, noise=0.3)) for seed in (0, 1))
    at = np.random.default_rng(10).uniform([-3, -3, 0.2], [3, 3, 0.8], (500, 3))
    a, b = one.query(at), other.query(at)
    z2 = (a.field - b.field) ** 2 / (a.variance + b.variance)
    # Both lack the same small structure, which cancels here: the scores are below one.
    assert 0.1 < np.mean(z2) < 1.5


def test_one_optitrack_run_predicts_the_other(shared_data: Path) -> None:
    with np.load(shared_data / "optitrack_handheld_2runs.npz") as data:
        R = Rotation.from_quat(data["quaternion_wxyz"].astype(float), scalar_first=True)
        field, points = R.apply(data["mag_uT"].astype(float)), data["position"].astype(float)
        first = data["run"] == 0
    ours = SlidingGP.fit(points[first], field[first])
    distance, _ = cKDTree(points[first]).query(points[~first])
    near = distance < 0.03
    sample = ours.query(points[~first][near])
    error = sample.field - field[~first][near]
    noise = ours.trained.hyperparameters.noise
    assert sample.inside.all()
    # The data's README names 0.2 to 0.3 uT per axis, of a field of 2 to 4, for such points; the
    # unknown lever arm of the magnetometer is in it.
    assert np.sqrt(np.mean(error**2)) < 0.35
    assert 0.5 < np.sqrt(np.mean(error**2 / (sample.variance + noise**2))) < 1.5


def test_a_uniform_field_leaves_the_hyperparameters_alone() -> None:
    points, field = survey(dipole_world(2), 0, noise=0.1)
    options = KernelLearningOptions(neighbourhoods=3)
    one, other = (
        learn(training_set(points, values), options, ThinningOptions()).hyperparameters
        for values in (field, field + np.array([30.0, -20, 10]))
    )
    # The search stops where the likelihood is flat to 1e-9: 1e-4 of a parameter.
    assert other.length_scale == pytest.approx(one.length_scale, rel=1e-3)
    assert other.signal == pytest.approx(one.signal, rel=1e-3)
    assert other.noise == pytest.approx(one.noise, rel=1e-3)
