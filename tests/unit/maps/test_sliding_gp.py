from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from l2m_factors.field_map import DifferentiableMap
from l2m_gtsam.data import FieldSample, FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps import grid, sliding_gp
from l2m_gtsam.maps.build import KINDS, MapOptions, build_map, map_from_state
from l2m_gtsam.maps.dense_gp import DenseGP, DenseGPOptions
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters, KernelLearningOptions
from l2m_gtsam.maps.sliding_gp import SlidingGP, SlidingGPOptions
from l2m_gtsam.maps.training import ThinningOptions, thinned, training_set
from tests.support.central_differences import slopes
from tests.support.map_files import through_a_file
from tests.worlds.exact import dipole_world
from tests.worlds.quick_maps import quick

GIVEN = KernelHyperparameters(length_scale=0.8, signal=4.0, noise=0.2)
KEEP_ALL = ThinningOptions(spacing=0)
OPTIONS = SlidingGPOptions(hyperparameters=GIVEN)


def readings(count: int = 600) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(4)
    points = rng.uniform([-4, -4, 0.2], [4, 4, 0.8], (count, 3))
    field, _ = dipole_world(1).field_and_gradient(points)
    return points, field + rng.normal(0, GIVEN.noise, field.shape)


def queries(count: int = 400) -> FloatArray:
    return np.random.default_rng(5).uniform([-6, -6, -0.5], [6, 6, 2], (count, 3))


@pytest.fixture(scope="module")
def sliding() -> SlidingGP:
    return SlidingGP.fit(*readings(), OPTIONS)


def assert_same(one: FieldSample, other: FieldSample, tolerance: float) -> None:
    for name in ("field", "gradient", "variance", "inside"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=tolerance, atol=tolerance
        )


@pytest.mark.parametrize("block", [1.0, 2.5, 30.0])
def test_blocks_that_see_all_data_agree_with_the_dense_process(block: float) -> None:
    given = {"hyperparameters": GIVEN, "thinning": KEEP_ALL}
    fast = SlidingGP.fit(
        *readings(300), SlidingGPOptions.model_validate({**given, "block": block, "margin": 10})
    )
    slow = DenseGP.fit(*readings(300), DenseGPOptions.model_validate(given))
    assert min(len(part.y) for part in fast.blocks) == 300
    # Both factorise a matrix of condition 1e5, so that digits end near 1e-11 of the field.
    tolerance = 1e-9 * GIVEN.signal
    for ours, theirs in zip(
        fast.field_and_gradient(queries()), slow.field_and_gradient(queries()), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance)
    np.testing.assert_allclose(
        fast.variance(queries()), slow.variance(queries()), rtol=0, atol=tolerance
    )
    assert_same(fast.query(queries()), slow.query(queries()), 1e-9)


def test_the_gradient_is_the_derivative_of_the_field(sliding: SlidingGP) -> None:
    _, gradient = sliding.field_and_gradient(queries())
    expected = slopes(lambda x: sliding.field_and_gradient(x)[0], queries(), 1e-5)
    # Rounding of 1e-11 uT over the step; no query is within the step of a border.
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-5)


def test_query_extends_smoothly_and_says_where_it_knows_nothing(sliding: SlidingGP) -> None:
    sample = sliding.query(queries())
    field, gradient = sliding.field_and_gradient(queries())
    variance, inside = sliding.variance(queries()), sample.inside
    assert 0 < inside.sum() < len(inside)
    # The same products in the same batches: equal to the last bit.
    np.testing.assert_array_equal(sample.field[inside], field[inside])
    np.testing.assert_array_equal(sample.gradient[inside], gradient[inside])
    np.testing.assert_array_equal(sample.variance[inside], variance[inside])
    assert np.isnan(sample.field[~inside]).all()
    assert np.isnan(sample.gradient[~inside]).all()
    assert np.isinf(sample.variance[~inside]).all()
    assert np.isfinite(field).all()


def test_inside_is_the_distance_to_the_nearest_reading(sliding: SlidingGP) -> None:
    kept = sliding.trained.readings.points
    distance = np.linalg.norm(queries()[:, None] - kept, axis=-1).min(axis=1)
    np.testing.assert_array_equal(
        sliding.query(queries()).inside, distance <= OPTIONS.reach * GIVEN.length_scale
    )


def test_a_gap_in_the_data_is_outside() -> None:
    points, field = readings()
    around = np.abs(points[:, :2]).max(axis=1) > 2
    ours = SlidingGP.fit(points[around], field[around], OPTIONS)
    sample = ours.query(np.array([[0.0, 0.0, 0.5], [3.0, 3.0, 0.5]]))
    np.testing.assert_array_equal(sample.inside, [False, True])


def test_the_order_of_queries_does_not_matter(sliding: SlidingGP) -> None:
    order = np.random.default_rng(6).permutation(len(queries()))
    one, other = sliding.query(queries()[order]), sliding.query(queries())
    # BLAS adds in another order where batches differ: rounding only.
    np.testing.assert_allclose(one.field, other.field[order], rtol=0, atol=1e-10)
    np.testing.assert_allclose(one.variance, other.variance[order], rtol=0, atol=1e-10)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3), min_size=1, max_size=20
    )
)
def test_a_trial_step_to_anywhere_is_finite(
    sliding: SlidingGP, anywhere: list[tuple[float, float, float]]
) -> None:
    points = np.array(anywhere)
    for answer in (*sliding.field_and_gradient(points), sliding.variance(points)):
        assert np.isfinite(answer).all()
    assert (sliding.variance(points) <= GIVEN.signal**2).all()


def test_no_points_give_no_answers(sliding: SlidingGP) -> None:
    sample = sliding.query(np.empty((0, 3)))
    assert sample.field.shape == (0, 3)
    assert sample.inside.shape == (0,)


def test_the_step_between_blocks_is_below_the_sigma() -> None:
    """The reason of the default margin."""
    points, field = readings(2500)
    ours = SlidingGP.fit(points, field, OPTIONS)
    rng = np.random.default_rng(7)
    border = np.column_stack(
        [np.zeros(500), rng.uniform(-3.5, 3.5, 500), rng.uniform(0.2, 0.8, 500)]
    )
    border[:, 0] = ours.grid.origin[0] + rng.integers(1, 4, 500) * ours.grid.size
    side = np.array([1e-9, 0, 0])
    left, right = ours.query(border - side), ours.query(border + side)
    steps = (left.field - right.field) / np.sqrt(left.variance)
    assert np.abs(steps).max() > 0  # two blocks did answer
    # A tenth, as the default promises, with room for the draw.
    assert np.sqrt(np.mean(steps**2)) < 0.15


def test_variances_do_not_depend_on_the_memory_for_whiteners(
    sliding: SlidingGP, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sliding_gp, "FACTOR_MEMORY", 0)
    lean = SlidingGP.fit(*readings(), OPTIONS)
    assert all(block.whitener is None for block in lean.blocks)
    assert_same(lean.query(queries()), sliding.query(queries()), 0.0)


def test_readings_that_disagree_at_one_place_are_averaged() -> None:
    points, field = readings(100)
    twice = np.vstack([points, points])
    offset = np.array([1.0, -2.0, 0.5])
    options = SlidingGPOptions(hyperparameters=GIVEN, thinning=KEEP_ALL)
    ours = SlidingGP.fit(twice, np.vstack([field + offset, field - offset]), options)
    halved = KernelHyperparameters(**{**GIVEN.model_dump(), "noise": GIVEN.noise / np.sqrt(2)})
    once = SlidingGP.fit(points, field, options.model_copy(update={"hyperparameters": halved}))
    # Two equally noisy readings are one of half the variance: condition 1e5, digits to 1e-10.
    assert_same(ours.query(queries()), once.query(queries()), 1e-8)


def test_thinning_counts_the_readings_it_merges() -> None:
    points, field = readings()
    merged = thinned(training_set(points, field), 1.0, ThinningOptions(independent=10_000))
    assert len(merged) < len(points)
    assert merged.weight.sum() == len(points)
    # Sums of 600 numbers of order 40.
    np.testing.assert_allclose(
        np.average(merged.field, axis=0, weights=merged.weight), field.mean(axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(
        np.average(merged.points, axis=0, weights=merged.weight), points.mean(axis=0), atol=1e-12
    )


def test_a_vehicle_at_rest_counts_no_more_than_allowed() -> None:
    points, field = readings(100)
    rest = np.vstack([points, np.tile(points[:1], (5000, 1))])
    readings_at_rest = training_set(rest, np.vstack([field, np.tile(field[:1], (5000, 1))]))
    merged = thinned(readings_at_rest, 0.5, ThinningOptions(independent=7))
    assert merged.weight.max() == 7


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_a_map_of_each_kind_comes_back_from_its_state(kind: str) -> None:
    ours = build_map(*readings(400), quick(kind))
    back = map_from_state(through_a_file(ours.to_state()))
    assert back.kind == ours.kind == kind
    assert_same(back.query(queries()), ours.query(queries()), 1e-12)  # as required
    assert back.summary.facts == ours.summary.facts
    assert back.to_state().options == ours.to_state().options


def test_a_summary_tells_what_went_in(sliding: SlidingGP) -> None:
    points, _ = readings()
    summary = sliding.summary
    assert summary.readings == len(points)
    assert summary.rows == len(sliding.trained.readings)
    assert (summary.lower >= points.min(axis=0)).all()
    assert (summary.upper <= points.max(axis=0)).all()
    assert summary.facts["blocks"] == len(sliding.blocks)
    assert summary.facts["length scale (m)"] == GIVEN.length_scale
    assert summary.facts["hyperparameters"] == "given"


def test_a_summary_tells_how_learning_ended() -> None:
    learnt = build_map(*readings(), MapOptions(kind="sliding_gp"))
    assert learnt.summary.facts["hyperparameters"] == "learnt"


def test_maps_satisfy_both_protocols(sliding: SlidingGP) -> None:
    """Mostly a statement to the type checker."""
    application: FieldMap = sliding
    plugin: DifferentiableMap = sliding
    field, gradient = plugin.field_and_gradient(queries(7))
    assert field.shape == (7, 3)
    assert gradient.shape == (7, 3, 3)
    assert application.kind == "sliding_gp"


def spoiled(row: int, value: float) -> FloatArray:
    field = readings()[1]
    field[row, 1] = value
    return field


POINTS, FIELD = readings()
BAD_READINGS: list[tuple[FloatArray, FloatArray, str]] = [
    (POINTS[:, :2], FIELD, r"map points have shape \(600, 2\); \(N, 3\) is needed"),
    (POINTS, FIELD[:-1], r"shape \(599, 3\) .* 600 points need \(600, 3\)"),
    (POINTS, spoiled(17, np.nan), "training reading 17 of 600 is not finite"),
    (spoiled(3, np.inf), FIELD, "map point 3 of 600 is not finite"),
    (POINTS[:4], FIELD[:4], "at least 10 training readings, got 4"),
    (np.tile(POINTS[:1], (600, 1)), FIELD, "taken at one point; a drive is needed"),
    (POINTS * 1e9, FIELD, "are they in metres"),
    (POINTS, FIELD * 1e6, "are they in microtesla"),
]


@pytest.mark.parametrize(("points", "field", "complaint"), BAD_READINGS)
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_bad_readings_are_refused_in_one_line(
    kind: str, points: FloatArray, field: FloatArray, complaint: str
) -> None:
    with pytest.raises(MapError, match=complaint) as caught:
        build_map(points, field, MapOptions(kind=kind))
    assert "\n" not in str(caught.value)


def test_bad_queries_are_refused(sliding: SlidingGP) -> None:
    bad = queries()
    bad[12, 2] = np.nan
    for ask in (sliding.query, sliding.field_and_gradient, sliding.variance):
        with pytest.raises(MapError, match="map point 12 of 400 is not finite"):
            ask(bad)
        with pytest.raises(MapError, match=r"shape \(3,\)"):
            ask(np.zeros(3))


def test_blocks_with_too_many_readings_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sliding_gp, "MOST_IN_BLOCK", 50)
    with pytest.raises(MapError, match="at most 50 are allowed; a larger spacing"):
        SlidingGP.fit(*readings(), OPTIONS)


def test_too_many_blocks_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid, "MOST_BLOCKS", 5)
    with pytest.raises(MapError, match=r"blocks of 2 m, at most 5 are allowed"):
        SlidingGP.fit(*readings(), OPTIONS)


def test_a_noise_too_small_to_factorise_is_refused() -> None:
    silent = KernelHyperparameters(length_scale=5, signal=4, noise=1e-9)
    options = SlidingGPOptions(hyperparameters=silent, thinning=KEEP_ALL)
    with pytest.raises(MapError, match="not positive definite at noise 1e-09 uT"):
        SlidingGP.fit(*readings(), options)


def test_a_reach_beyond_the_margin_is_refused() -> None:
    with pytest.raises(ValidationError, match="reach 3 must not exceed margin 2"):
        SlidingGPOptions(reach=3, margin=2)


def test_an_unknown_kind_is_refused_with_the_kinds_there_are() -> None:
    known = r"'spline' is not known; harmonic, sliding_gp, bilinear, dense_gp are"
    with pytest.raises(ValidationError, match=known):
        MapOptions(kind="spline")
    with pytest.raises(MapError, match=known):
        map_from_state(MapState("spline", {}, {}, {}))


DAMAGE: list[tuple[str, npt.NDArray[Any], str]] = [
    ("points", np.full((600, 3), np.nan), "is not finite"),
    ("points", np.zeros((600, 2)), "shape"),
    ("field", np.zeros((5, 3)), "shape"),
    ("weight", np.zeros(600), "is not finite and of positive weight"),
    ("weight", np.array(["a"] * 600), "numeric array weight"),
    ("hyperparameters", np.ones(4), r"\(3,\) is needed"),
    ("hyperparameters", np.array([1.0, np.nan, 1.0]), "damaged: signal"),
    ("hyperparameters", np.array([1.0, 1.0, 0.0]), "damaged: noise"),
]


@pytest.mark.parametrize(("name", "array", "complaint"), DAMAGE)
def test_a_damaged_array_is_refused(name: str, array: npt.NDArray[Any], complaint: str) -> None:
    options = SlidingGPOptions(hyperparameters=GIVEN, thinning=KEEP_ALL)
    state = SlidingGP.fit(*readings(), options).to_state()
    with pytest.raises(MapError, match=complaint):
        map_from_state(replace(state, arrays={**state.arrays, name: array}))


@pytest.mark.parametrize("name", ["points", "field", "weight", "hyperparameters"])
def test_a_missing_array_is_named(sliding: SlidingGP, name: str) -> None:
    state = sliding.to_state()
    arrays = {key: array for key, array in state.arrays.items() if key != name}
    with pytest.raises(MapError, match=f"needs a numeric array {name}"):
        map_from_state(replace(state, arrays=arrays))


def test_damaged_options_and_provenance_are_refused(sliding: SlidingGP) -> None:
    state = sliding.to_state()
    with pytest.raises(MapError, match="map options are damaged: block"):
        map_from_state(replace(state, options={"block": "wide"}))
    with pytest.raises(MapError, match="map state is damaged: readings"):
        map_from_state(replace(state, provenance={}))


def test_hyperparameters_on_a_bound_are_told() -> None:
    points, _ = readings(200)
    exact = np.sin(points[:, ::-1] / 2)
    learning = KernelLearningOptions(readings=100)
    ours = SlidingGP.fit(points, exact, SlidingGPOptions(learning=learning, thinning=KEEP_ALL))
    assert "not determined by the data: noise" in ours.summary.facts["hyperparameters"]
