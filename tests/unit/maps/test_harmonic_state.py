"""A harmonic map's state: it comes back from it, and refuses a damaged one."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from tests.support.map_files import through_a_file
from tests.worlds.harmonic import assert_same, queries, readings

pytestmark = pytest.mark.usefixtures("affordable")


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
