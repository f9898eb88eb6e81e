"""A harmonic map's state, and what it makes of damage and of bad or meagre data."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.training import additional_set, training_set
from tests.harmonic_models import (
    NO_SEARCH,
    OPTIONS,
    POST,
    WORLD,
    assert_same,
    fitted_map,
    queries,
    readings,
    refuse_large_windows,
    rms,
    within_survey,
)
from tests.worlds import DipoleWorld


@pytest.fixture(autouse=True)
def affordable(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_large_windows(monkeypatch)


@pytest.fixture(scope="module")
def harmonic() -> HarmonicMap:
    return fitted_map()


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
    ("hyperparameters", np.array([1e-300, 1, 1, 1, 1, 1]), "damaged: ceiling_depth is 1e-300"),
    ("hyperparameters", np.array([1.0, 1, 1, 1e300, 1, 1]), "damaged: floor_scale is 1e"),
    ("hyperparameters", np.full(6, 1e-300), "damaged: ceiling_depth.*; build the map again"),
    ("sources", np.zeros((3, 2)), "sources are damaged"),
    ("sources", np.zeros(3), "sources are damaged"),
    ("sources", np.full((7, 3), np.inf), "sources are damaged"),
    ("sources", np.array(0.0), "sources are damaged"),
    ("structure", np.array(0), "sources are damaged"),
    ("structure", np.array([0, 5]), "sources are damaged"),
    ("structure", np.full(7, np.nan), "sources are damaged"),
    ("structure", np.full(7, 1e300), "sources are damaged"),
    ("structure", np.zeros((7, 1), dtype=np.int64), "sources are damaged"),
    ("strengths", np.array(1.0), "sources are damaged"),
    ("strengths", np.array([-1.0]), "sources are damaged"),
    ("strengths", np.array([np.nan]), "sources are damaged"),
    ("strengths", np.array([1e300]), "sources are damaged"),
    ("strengths", np.ones(2), "sources are damaged"),
    ("strengths", np.ones((1, 1)), "sources are damaged.*; build the map again"),
    ("tiling", np.zeros(2), "tiling is damaged"),
    ("tiling", np.array(1.0), "tiling is damaged"),
    ("tiling", np.array([0.0, np.nan, 1.5]), "tiling is damaged"),
    ("tiling", np.array([1e300, 0, 1.5]), "tiling is damaged: its origin.*; build the map again"),
    ("tiling", np.array([0.0, -1e20, 1.5]), "tiling is damaged: its origin"),
    ("tiling", np.array([0.0, 0, -1.5]), "tiling is damaged: a tile is -1.5 m"),
    ("tiling", np.array([0.0, 0, 1e-300]), "tiling is damaged: a tile is 1e-300 m"),
    ("tiling", np.array([0.0, 0, 1e300]), "tiling is damaged: a tile is 1e"),
    ("tiling", np.array([0.0, 0, 100]), "tiling is damaged: tiles and waves"),
    ("resolution", np.ones(3), "resolution is damaged"),
    ("resolution", np.array(1.0), "resolution is damaged"),
    ("resolution", np.array([5.0, np.nan]), "resolution is damaged"),
    ("resolution", np.array([-5.0, 5.0]), "resolution is damaged"),
    ("resolution", np.array([5.0, 1e-300]), "resolution is damaged"),
    ("resolution", np.array([5.0, 1e300]), "resolution is damaged.*; build the map again"),
    ("resolution", np.array([5.0, 500.0]), "tiling is damaged: tiles and waves"),
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


ARRAYS = [
    "points",
    "field",
    "weight",
    "hyperparameters",
    "sources",
    "structure",
    "strengths",
    "tiling",
    "resolution",
]


@pytest.mark.parametrize("name", ARRAYS)
def test_a_missing_array_is_named(harmonic: HarmonicMap, name: str) -> None:
    state = harmonic.to_state()
    assert sorted(ARRAYS) == sorted(state.arrays)
    arrays = {key: array for key, array in state.arrays.items() if key != name}
    with pytest.raises(MapError, match=f"needs a numeric array {name}"):
        HarmonicMap.from_state(replace(state, arrays=arrays))


@pytest.mark.parametrize("extreme", [1e-9, 1e9])
def test_hyperparameters_far_beyond_those_of_learning_are_accepted(
    harmonic: HarmonicMap, extreme: float
) -> None:
    """They may have been given; at the ends of what is accepted nothing overflows."""
    state = harmonic.to_state()
    for number in range(6):
        values = state.arrays["hyperparameters"].copy()
        values[number] = extreme
        arrays = {**state.arrays, "hyperparameters": values}
        sample = HarmonicMap.from_state(replace(state, arrays=arrays)).query(queries(10))
        assert not np.isnan(sample.variance).any()


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


def test_few_readings_and_readings_at_rest_can_be_added(harmonic: HarmonicMap) -> None:
    """They make no map, but a map that exists can learn from them."""
    points, field = readings(5, seed=9)
    at_rest = np.tile(points[:1], (50, 1)), np.tile(field[:1], (50, 1))
    for p, b in ((points, field), (points[:1], field[:1]), at_rest):
        with pytest.raises(MapError):
            training_set(p, b)
        new = additional_set(p, b)
        np.testing.assert_array_equal(new.points, p)
        np.testing.assert_array_equal(new.field, b)
        np.testing.assert_array_equal(new.weight, 1.0)
        learnt = harmonic.learnt.extended(new, harmonic.options)
        assert learnt.origin.readings == harmonic.learnt.origin.readings + len(p)
        sample = HarmonicMap.condition(learnt, harmonic.options).query(p)
        assert sample.inside.all()


def test_bad_additional_readings_are_refused_in_one_line() -> None:
    points, field = readings(5)
    bad: list[tuple[FloatArray, FloatArray, str]] = [
        (points[:0], field[:0], "no readings to add to the map"),
        (spoiled(points), field, "map point 3 of 5 is not finite"),
        (points, spoiled(field), "training reading 3 of 5 is not finite"),
        (points[:, :2], field, r"shape \(5, 2\)"),
        (points, field[:4], "5 points need"),
        (points * 1e9, field, "are they in metres"),
        (points, field * 1e9, "are they in microtesla"),
    ]
    for p, b, complaint in bad:
        with pytest.raises(MapError, match=complaint) as caught:
            additional_set(p, b)
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


def test_places_that_disagree_make_no_sure_map() -> None:
    """Ten pairs of readings two centimetres apart and 5 uT apart, none of them merged."""
    along, across = np.repeat(0.1 * np.arange(10), 2), np.tile([0.0, 0.02], 10)
    points = np.column_stack([along, across, np.full(20, 0.4)])
    field = np.tile([20.0, 0.0, -40.0], (20, 1))
    field[::2] += 5
    ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH, merge=0.01))
    assert len(ours.learnt.readings) == 20
    # The mean of readings that are 2.5 uT off it is the best there is.
    assert np.sqrt(ours.variance(points)).min() > 2.5 / np.sqrt(20)


def test_two_places_that_disagree_make_no_map() -> None:
    """Twenty readings within two centimetres, 5 uT apart."""
    points = np.repeat([[0.0, 0.0, 0.4], [0.02, 0.0, 0.4]], 10, axis=0)
    field = np.tile([20.0, 0.0, -40.0], (20, 1))
    field[10:] += 5
    with pytest.raises(MapError, match="readings fill 1 cubes of") as caught:
        HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
    assert "\n" not in str(caught.value)


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
