"""The harmonic map as a whole: its statistics, its state, its errors, and what it refuses."""

import json
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors.field_map import FieldMap as PluginFieldMap
from l2m_gtsam.data import FieldSample, FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.graph.uncertain import UncertainMap
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.harmonic import learning
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.error_modes import ErrorModes
from l2m_gtsam.maps.harmonic.error_options import ErrorOptions
from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.furnish import basis_of
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.search import SearchOptions
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.sliding_gp import SlidingGP
from tests.worlds import DipoleWorld, dipole_world

WORLD = dipole_world(1)
GIVEN = Hyperparameters(
    floor_scale=1.6, floor_depth=0.7, ceiling_scale=0.5, ceiling_depth=1.4, noise=0.2
)
NO_SEARCH = SearchOptions(rounds=0)
# Coarse and fast.
OPTIONS = HarmonicOptions(hyperparameters=GIVEN, search=NO_SEARCH, modes=200, mode_share=0.5)
POST = np.column_stack([np.full(20, 0.3), np.full(20, 1.6), np.linspace(0, 1.5, 20)])
STEEL = DipoleWorld(np.zeros(3), POST[::4], np.random.default_rng(6).normal(0, 6, (5, 3)))


def readings(count: int = 600, seed: int = 0, east: float = 0.0) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([east - 1.5, -1.2, 0.2], [east + 1.5, 1.2, 0.8], (count, 3))
    field = WORLD.field_and_gradient(points)[0] + STEEL.field_and_gradient(points)[0]
    return points, field + rng.normal(0, GIVEN.noise, field.shape)


def queries(count: int = 300) -> FloatArray:
    return np.random.default_rng(5).uniform([-3, -3, -0.3], [3, 3, 1.5], (count, 3))


def within_survey(count: int = 300) -> FloatArray:
    return np.random.default_rng(6).uniform([-1.4, -1.1, 0.2], [1.4, 1.1, 0.8], (count, 3))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(autouse=True)
def affordable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail at once where a window would have thousands of modes: minutes and gigabytes."""

    def checked(*arguments: Any) -> Basis:
        basis = basis_of(*arguments)
        assert len(basis) < 2000
        return basis

    monkeypatch.setattr(learning, "basis_of", checked)


@pytest.fixture(scope="module")
def harmonic() -> HarmonicMap:
    ours = HarmonicMap.fit(*readings(), OPTIONS, POST)
    assert ours.learnt.strengths.max() > 0
    return ours


def assert_same(one: FieldSample, other: FieldSample, tolerance: float) -> None:
    np.testing.assert_array_equal(one.inside, other.inside)
    for name in ("field", "gradient", "variance"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=tolerance, atol=tolerance
        )


def test_a_survey_of_dipoles_is_predicted_with_a_true_sigma() -> None:
    """Everything by default, in a world that is not made of the map's features."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -4, 0.2], [4, 4, 0.8], (4000, 3))
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field)
    at = rng.uniform([-3.5, -3.5, 0.2], [3.5, 3.5, 0.8], (1000, 3))
    sample, (truth, slope) = ours.query(at), WORLD.field_and_gradient(at)
    error = sample.field - truth
    theirs = SlidingGP.fit(points, field).query(at).field - truth
    assert sample.inside.all()
    # 0.040 against 0.091 uT; three heights at random help the independent axes.
    assert rms(error) < 0.55 * rms(theirs)
    assert rms(sample.gradient - slope) < 0.3 * rms(slope)
    # Some 300 independent scores.
    assert 0.8 < rms(error / np.sqrt(sample.variance)) < 1.2
    assert ours.learnt.hyperparameters.noise == pytest.approx(0.2, rel=0.1)
    assert ours.learnt.origin.learning.at_bound == ()


def test_query_extends_smoothly_and_says_where_it_knows_nothing(harmonic: HarmonicMap) -> None:
    sample = harmonic.query(queries())
    field, gradient = harmonic.field_and_gradient(queries())
    inside = sample.inside
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(sample.field[inside], field[inside])
    np.testing.assert_array_equal(sample.gradient[inside], gradient[inside])
    np.testing.assert_array_equal(sample.variance[inside], harmonic.variance(queries())[inside])
    assert np.isnan(sample.field[~inside]).all()
    assert np.isnan(sample.gradient[~inside]).all()
    assert np.isinf(sample.variance[~inside]).all()
    assert np.isfinite(field).all()


def test_inside_ends_at_the_reach(harmonic: HarmonicMap) -> None:
    kept = harmonic.learnt.readings.points
    away = np.linalg.norm(queries()[:, None] - kept, axis=-1).min(axis=1)
    assert not harmonic.query(queries()).inside[away > OPTIONS.reach].any()
    assert harmonic.query(within_survey()).inside.all()


def test_the_order_of_queries_does_not_matter(harmonic: HarmonicMap) -> None:
    order = np.random.default_rng(6).permutation(300)
    one, other = harmonic.query(queries()[order]), harmonic.query(queries())
    # BLAS adds in another order where batches differ: rounding only.
    np.testing.assert_allclose(one.field, other.field[order], rtol=0, atol=1e-10)
    np.testing.assert_allclose(one.variance, other.variance[order], rtol=1e-10)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3, allow_nan=False)] * 3), min_size=1, max_size=10))
def test_a_trial_step_to_anywhere_is_finite(
    harmonic: HarmonicMap, anywhere: list[tuple[float, float, float]]
) -> None:
    """A kilometre up, down or away; and never surer there than inside."""
    points = np.array(anywhere)
    field, gradient = harmonic.field_and_gradient(points)
    variance = harmonic.variance(points)
    assert np.isfinite(field).all()
    assert np.isfinite(gradient).all()
    assert np.isfinite(variance).all()


@pytest.mark.parametrize("towards", [[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
def test_beyond_the_survey_the_map_knows_less_and_less(
    harmonic: HarmonicMap, towards: list[float]
) -> None:
    """From the middle outwards: at three metres no better than the field varies."""
    steps = np.linspace(0, 4, 9)[:, None]
    variance = harmonic.variance(np.array([0.0, 0.0, 0.5]) + steps * towards).sum(axis=1)
    far = np.array([0.0, 0.0, 0.5]) + steps[6:] * towards
    assert variance[6:].min() > 50 * variance[0]
    assert not harmonic.query(far).inside.any()


def through_a_file(state: MapState) -> MapState:
    """What is left of a state when options and provenance went through JSON."""
    options, provenance = json.loads(json.dumps([state.options, state.provenance]))
    return MapState(state.kind, state.arrays, options, provenance)


def test_a_map_comes_back_from_its_state(harmonic: HarmonicMap) -> None:
    back = HarmonicMap.from_state(through_a_file(harmonic.to_state()))
    assert_same(back.query(queries()), harmonic.query(queries()), 1e-10)  # as required
    assert back.summary.facts == harmonic.summary.facts
    again = back.to_state()
    assert again.options == harmonic.to_state().options
    assert again.provenance == harmonic.to_state().provenance


def test_facts_of_a_map_are_strict_json(harmonic: HarmonicMap) -> None:
    """Others than Python read the header of a map file: no NaN."""
    state = harmonic.to_state()
    json.dumps([state.options, state.provenance], allow_nan=False)


def test_a_learnt_map_comes_back_from_its_state() -> None:
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 100}, "search": {"rounds": 0}, "modes": 200}
    )
    ours = HarmonicMap.fit(*readings(), options)
    back = HarmonicMap.from_state(through_a_file(ours.to_state()))
    assert_same(back.query(queries()), ours.query(queries()), 1e-10)
    assert back.learnt.origin == ours.learnt.origin


def test_an_updated_map_comes_back_from_its_state(harmonic: HarmonicMap) -> None:
    """Its tiles were laid for the first readings; a file must not lay them anew."""
    ours = harmonic.updated(*readings(400, seed=9, east=2.0))
    back = HarmonicMap.from_state(through_a_file(ours.to_state()))
    assert_same(back.query(queries()), ours.query(queries()), 1e-10)


def test_tiles_keep_to_their_number_of_modes() -> None:
    """Fine structure in a dense survey: what the modes cannot hold counts as variance."""
    fine = GIVEN.model_copy(update={"floor_depth": 0.15, "floor_scale": 5.0})
    points, field = readings(200)
    options = HarmonicOptions(hyperparameters=fine, search=NO_SEARCH, modes=100)
    ours = HarmonicMap.fit(0.4 * points, field, options)
    # "About how many": the modes along the axes come on top of the area's.
    assert max(len(tile.basis) for tile in ours.tiles) < 2 * options.modes


def test_a_summary_tells_what_went_in(harmonic: HarmonicMap) -> None:
    points, _ = readings()
    summary = harmonic.summary
    assert summary.kind == "harmonic"
    assert summary.readings == len(points)
    assert summary.rows == len(harmonic.learnt.readings)
    assert (summary.lower >= points.min(axis=0)).all()
    assert (summary.upper <= points.max(axis=0)).all()
    assert summary.facts["tiles"] == len(harmonic.tiles)
    for name, fact in summary.facts.items():  # plain values, as promised
        assert type(fact) in (str, int, float, bool), name


def test_maps_satisfy_all_protocols(harmonic: HarmonicMap) -> None:
    """Mostly a statement to the type checker."""
    application: FieldMap = harmonic
    plugin: PluginFieldMap = harmonic
    assert isinstance(harmonic, UncertainMap)
    assert plugin.field_and_gradient(queries(7))[1].shape == (7, 3, 3)
    assert application.kind == "harmonic"


def assert_conditioned_on_all(ours: HarmonicMap) -> None:
    """Every tile is the posterior for the readings that are its members now."""
    whole = HarmonicMap.condition(ours.learnt, ours.options)
    # Equal numbers but for the order of sums, of which 1e6 remain in the condition.
    assert_same(ours.query(queries()), whole.query(queries()), 1e-8)
    for one, other in zip(ours.tiles, whole.tiles, strict=True):
        assert len(one.basis) == len(other.basis)


def test_an_updated_map_is_conditioned_on_all_readings(harmonic: HarmonicMap) -> None:
    ours = harmonic.updated(*readings(400, seed=9, east=2.0))
    assert ours.learnt.hyperparameters == harmonic.learnt.hyperparameters
    assert len(ours.tiles) > len(harmonic.tiles)
    assert_conditioned_on_all(ours)
    assert ours.summary.readings == 1000


def test_updates_in_parts_are_one_update(harmonic: HarmonicMap) -> None:
    points, field = readings(400, seed=9)
    parts = harmonic
    for rows in (slice(0, 150), slice(150, None)):
        parts = parts.updated(points[rows], field[rows])
    # Means of means.
    assert_same(parts.query(queries()), harmonic.updated(points, field).query(queries()), 1e-8)


def test_new_readings_in_a_corner_leave_the_other_tiles_alone(harmonic: HarmonicMap) -> None:
    points, field = readings(100, seed=9)
    ours = harmonic.updated(points * 0.1 + [1.4, 1.1, 0.4], field)
    kept = sum(any(new is old for old in harmonic.tiles) for new in ours.tiles)
    assert 0 < kept < len(ours.tiles)
    assert_conditioned_on_all(ours)


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
    assert harmonic.errors_over(np.empty((0, 3))).covariance.shape == (0, 0)


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
    prior = np.exp(-basis.prior(GIVEN).log_variance)
    information = normal_of(basis, kept).FF / GIVEN.noise**2 + np.diag(prior)
    F = basis.features(kept.points) * kept.weight[:, None, None] / GIVEN.noise**2
    seen = F.reshape(-1, len(basis)).T @ noise[rows].reshape(-1, noise.shape[2])
    return np.asarray(basis.features(at[None])[0] @ np.linalg.solve(information, seen))


def test_tiles_share_the_errors_that_shared_noise_makes(harmonic: HarmonicMap) -> None:
    """Surveys of one field that differ by their noise: covariance of two tiles' errors."""
    draws = 4000
    told = fine_errors(harmonic, within_survey(1500))
    sizes, kept = told.sizes(), harmonic.learnt.readings
    starts = dict(zip(sizes, np.cumsum([0, *sizes.values()])[:-1].tolist(), strict=True))
    rng = np.random.default_rng(8)
    noise = rng.normal(0, GIVEN.noise, (len(kept), 3, draws)) / np.sqrt(kept.weight)[:, None, None]
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


DAMAGE: list[tuple[str, npt.NDArray[Any], str]] = [
    ("points", np.full((600, 3), np.nan), "is not finite"),
    ("points", np.zeros((600, 2)), "shape"),
    ("field", np.zeros((5, 3)), "shape"),
    ("field", np.full((600, 3), np.nan), "shape|is not finite"),
    ("weight", np.zeros(600), "shape|positive weight"),
    ("weight", np.array(["a"] * 600), "numeric array weight"),
    ("hyperparameters", np.ones(4), "hyperparameters"),
    ("hyperparameters", np.ones(9), "hyperparameters"),
    ("hyperparameters", np.ones((6, 1)), "damaged|hyperparameters"),
    ("hyperparameters", np.array(1.0), "hyperparameters"),
    ("hyperparameters", np.array([1.0, np.nan, 1, 1, 1, 1]), "damaged"),
    ("hyperparameters", np.array([1.0, 1, 1, 1, 0, 1]), "damaged: noise"),
    ("sources", np.zeros((3, 2)), "sources are damaged"),
    ("sources", np.zeros(3), "sources are damaged"),
    ("sources", np.full((7, 3), np.inf), "sources are damaged"),
    ("sources", np.array(0.0), "sources are damaged"),
    ("structure", np.array(0), "sources are damaged"),
    ("structure", np.array([0, 5]), "sources are damaged"),
    ("structure", np.full(7, np.nan), "sources are damaged"),
    ("structure", np.zeros((7, 1), dtype=np.int64), "sources are damaged"),
    ("strengths", np.array(1.0), "sources are damaged"),
    ("strengths", np.array([-1.0]), "sources are damaged"),
    ("strengths", np.array([np.nan]), "sources are damaged"),
    ("strengths", np.ones(2), "sources are damaged"),
    ("strengths", np.ones((1, 1)), "sources are damaged"),
]


@pytest.mark.parametrize(
    ("name", "array", "complaint"), DAMAGE, ids=[f"{i}-{d[0]}" for i, d in enumerate(DAMAGE)]
)
def test_a_damaged_array_is_refused(
    harmonic: HarmonicMap, name: str, array: npt.NDArray[Any], complaint: str
) -> None:
    state = harmonic.to_state()
    if state.arrays[name].shape[:1] != array.shape[:1] and array.shape[:1] == (7,):
        array = np.resize(array, (len(state.arrays[name]), *array.shape[1:]))
    with pytest.raises(MapError, match=complaint) as caught:
        HarmonicMap.from_state(replace(state, arrays={**state.arrays, name: array}))
    assert "\n" not in str(caught.value)


ARRAYS = ["points", "field", "weight", "hyperparameters", "sources", "structure", "strengths"]


@pytest.mark.parametrize("name", ARRAYS)
def test_a_missing_array_is_named(harmonic: HarmonicMap, name: str) -> None:
    state = harmonic.to_state()
    assert sorted(set(ARRAYS) - set(state.arrays)) == []
    arrays = {key: array for key, array in state.arrays.items() if key != name}
    with pytest.raises(MapError, match=f"needs a numeric array {name}"):
        HarmonicMap.from_state(replace(state, arrays=arrays))


def test_damaged_options_and_provenance_are_refused(harmonic: HarmonicMap) -> None:
    state = harmonic.to_state()
    with pytest.raises(MapError, match="map options are damaged: modes"):
        HarmonicMap.from_state(replace(state, options={"modes": "many"}))
    with pytest.raises(MapError, match="map state is damaged: readings"):
        HarmonicMap.from_state(replace(state, provenance={}))


def test_bad_queries_are_refused(harmonic: HarmonicMap) -> None:
    bad = queries()
    bad[12, 2] = np.nan
    for ask in (harmonic.query, harmonic.field_and_gradient, harmonic.variance):
        with pytest.raises(MapError, match="map point 12 of 300 is not finite"):
            ask(bad)
        with pytest.raises(MapError, match=r"shape \(3,\)"):
            ask(np.zeros(3))
    with pytest.raises(MapError, match="map point 12 of 300 is not finite"):
        harmonic.errors_over(bad)


# Bad input of the issue: a clear line, or a map that is not sure where it has no data.


def spoiled(array: FloatArray) -> FloatArray:
    array = array.copy()
    array[3, 1] = np.nan
    return array


@pytest.mark.parametrize("cloud", [None, POST])
def test_bad_readings_are_refused_in_one_line(cloud: FloatArray | None) -> None:
    points, field = readings()
    bad: list[tuple[FloatArray, FloatArray, str]] = [
        (spoiled(points), field, "map point 3 of 600 is not finite"),
        (points, spoiled(field), "training reading 3 of 600 is not finite"),
        (points[:, :2], field, r"shape \(600, 2\)"),
        (points[:5], field[:5], "at least 10"),
        (points[:0], field[:0], "at least 10"),
    ]
    for p, b, complaint in bad:
        with pytest.raises(MapError, match=complaint) as caught:
            HarmonicMap.fit(p, b, OPTIONS, cloud)
        assert "\n" not in str(caught.value)


def test_bad_clouds_are_refused_in_one_line() -> None:
    for cloud in (spoiled(POST), POST[:, :2], POST * 1e30):
        with pytest.raises(MapError) as caught:
            HarmonicMap.fit(*readings(), OPTIONS, cloud)
        assert "\n" not in str(caught.value)


def scores(ours: HarmonicMap, world: DipoleWorld, at: FloatArray) -> FloatArray:
    """Return errors over sigmas at points inside the map, shape (K, 3)."""
    sample = ours.query(at)
    inside = sample.inside
    truth, _ = world.field_and_gradient(at[inside])
    return np.asarray((sample.field[inside] - truth) / np.sqrt(sample.variance[inside]))


def test_a_survey_on_one_line_is_not_sure_beside_it() -> None:
    """Everything learnt, at most what 400 readings on eight metres can tell."""
    x = np.linspace(-4, 4, 400)
    points = np.column_stack([x, np.zeros(400), np.full(400, 0.4)])
    rng = np.random.default_rng(3)
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
    at = points[::4].repeat(3, axis=0)
    aside = rng.uniform(0.1, 0.45, len(at)) * np.exp(1j * rng.uniform(0, 2 * np.pi, len(at)))
    beside = at + np.column_stack([np.zeros(len(at)), aside.real, aside.imag])
    assert ours.variance(beside).sum() > 4 * ours.variance(at).sum()
    z = scores(ours, WORLD, beside)
    # One draw of a strongly correlated error; a sure map would be at ten.
    assert len(z) == 0 or rms(z) < 3


def test_a_vertical_line_is_not_sure_beside_it() -> None:
    z = np.linspace(0.2, 1.8, 200)
    points = np.column_stack([np.zeros(200), np.zeros(200), z])
    rng = np.random.default_rng(4)
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
    beside = points + np.array([0.3, 0.2, 0])
    assert ours.variance(beside).sum() > ours.variance(points).sum()
    assert rms(scores(ours, WORLD, beside)) < 3


def test_readings_at_one_point_that_disagree_are_averaged() -> None:
    points, field = readings()
    offset = np.array([5.0, -5.0, 3.0])
    twice = np.vstack([points, points[:1], points[:1]])
    one = HarmonicMap.fit(
        twice, np.vstack([field, field[:1] + offset, field[:1] - offset]), OPTIONS
    )
    other = HarmonicMap.fit(twice, np.vstack([field, field[:1], field[:1]]), OPTIONS)
    assert_same(one.query(queries()), other.query(queries()), 1e-8)


def test_two_places_that_disagree_make_no_sure_map() -> None:
    """Twenty readings within two centimetres, 5 uT apart."""
    points = np.repeat([[0.0, 0.0, 0.4], [0.02, 0.0, 0.4]], 10, axis=0)
    field = np.tile([20.0, 0.0, -40.0], (20, 1))
    field[::2] += 5
    with suppress(MapError):  # a clear line is an answer too
        ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
        sigma = np.sqrt(ours.variance(points[:1]))
        assert sigma.min() > 5 / np.sqrt(20) / 2


def test_between_two_surveys_the_map_knows_nothing() -> None:
    """Thirty metres apart, many tiles of none."""
    points, field = readings()
    away = np.array([30.0, 0, 0])
    far = WORLD.field_and_gradient(points + away)[0]
    ours = HarmonicMap.fit(np.vstack([points, points + away]), np.vstack([field, far]), OPTIONS)
    gap = np.column_stack([np.linspace(2.2, 27.8, 60), np.zeros(60), np.full(60, 0.5)])
    assert not ours.query(gap).inside.any()
    assert np.isfinite(ours.field_and_gradient(gap)[0]).all()
    assert ours.query(within_survey()).inside.all()
    assert ours.query(within_survey() + away).inside.all()
    # The waves of a box come again beyond it; what is known of them must not.
    known = ours.variance(within_survey()).sum(axis=1)
    assert ours.variance(gap).sum(axis=1).min() > 10 * np.median(known)


def test_a_long_reach_does_not_make_a_map_sure_of_the_unknown() -> None:
    options = OPTIONS.model_copy(update={"reach": 4.0})
    ours = HarmonicMap.fit(*readings(), options)
    beyond = np.column_stack([np.linspace(2.5, 5.0, 60), np.zeros(60), np.full(60, 0.5)])
    # All of it within four metres of a reading, none within one.
    known = ours.query(beyond).inside
    truth, _ = WORLD.field_and_gradient(beyond[known])
    error = ours.field_and_gradient(beyond[known])[0] - truth
    assert (np.abs(error) < 5 * np.sqrt(ours.variance(beyond[known]))).all()


def cage(seed: int) -> DipoleWorld:
    """Steel all around a drive that sees 300 uT of it."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([-2.5, -2.2, -0.5], [2.5, 2.2, 2.0], (400, 3))
    around = (np.abs(places[:, 0]) > 2) | (np.abs(places[:, 1]) > 1.7)
    around |= (places[:, 2] < -0.2) | (places[:, 2] > 1.4)
    places = places[around]
    return DipoleWorld(WORLD.uniform, places, rng.normal(0, 120, places.shape))


def test_readings_in_a_metal_cage_are_told_with_their_sigma() -> None:
    world, (points, _) = cage(5), readings()
    rng = np.random.default_rng(5)
    field = world.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    assert rms(field - field.mean(axis=0)) > 30
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 200}, "search": {"rounds": 0}, "modes": 300}
    )
    ours = HarmonicMap.fit(points, field, options)
    assert rms(scores(ours, world, within_survey())) < 2


def test_pure_noise_of_300_ut_is_known_nowhere() -> None:
    points, _ = readings()
    noise = np.random.default_rng(6).normal(0, 300, points.shape)
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 200}, "search": {"rounds": 0}, "modes": 300}
    )
    ours = HarmonicMap.fit(points, noise, options)
    # A mean of 600 readings of 300 uT is the best there is; a map of any slope knows less.
    assert np.sqrt(ours.variance(within_survey())).min() > 300 / np.sqrt(600) / 2


def test_a_uniform_field_is_known_inside() -> None:
    """Nothing but the Earth's field: no scale to learn, yet a map to calibrate C and H with."""
    points, _ = readings()
    rng = np.random.default_rng(7)
    field = np.array([22.0, 3, -38]) + rng.normal(0, 0.2, points.shape)
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 100}, "search": {"rounds": 0}, "modes": 200}
    )
    sample = HarmonicMap.fit(points, field, options).query(within_survey())
    assert sample.inside.all()
    error = sample.field - [22.0, 3, -38]
    assert rms(error) < 0.05
    assert rms(error / np.sqrt(sample.variance)) < 3  # one draw, correlated over all places
