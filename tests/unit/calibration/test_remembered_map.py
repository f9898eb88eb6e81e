"""A map that is asked for no place twice."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from inspect import getattr_static

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.calibration import view
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.view import RememberedMap
from l2m_gtsam.data import FieldSample, FloatArray
from tests.worlds.counting import Counting


@settings(max_examples=30)
@given(rows=st.lists(st.lists(st.integers(0, 30), max_size=20), min_size=1, max_size=6))
def test_answers_are_the_maps_own_and_places_are_asked_once(rows: list[list[int]]) -> None:
    """Any order, any repetition, also within one question, to the last bit."""
    places = np.random.default_rng(0).normal(size=(31, 3))
    counting = Counting()
    remembered = RememberedMap(counting)
    for chosen in rows:
        at = places[np.array(chosen, dtype=np.int64)]
        found, own = remembered.query(at), Counting().query(at)
        for name in ("field", "gradient", "variance", "inside"):
            np.testing.assert_array_equal(getattr(found, name), getattr(own, name))
        asked = counting.asked
        remembered.query(at)
        assert counting.asked == asked


def test_what_is_known_from_elsewhere_is_not_asked() -> None:
    """To the last bit; of places that were not told the map is asked."""
    counting, places = Counting(), np.random.default_rng(0).normal(size=(5, 3))
    remembered, told = RememberedMap(counting), Counting().query(places[:3])
    variance = np.full((3, 3), 7.0)
    remembered.remember(
        places[:3], FieldSample(told.field, told.gradient, variance, np.ones(3, dtype=np.bool_))
    )
    found = remembered.query(places)
    assert counting.asked == 2
    np.testing.assert_array_equal(found.field[:3], told.field)
    np.testing.assert_array_equal(found.variance, np.vstack([variance, places[3:] ** 2]))
    assert found.inside[:3].all()


@settings(max_examples=30)
@given(rows=st.lists(st.lists(st.integers(0, 30), max_size=20), min_size=1, max_size=6))
def test_fields_of_the_last_question_are_asked_once(rows: list[list[int]]) -> None:
    """Of the same places, some of them or more, in any order, to the last bit."""
    places = np.random.default_rng(0).normal(size=(31, 3))
    counting, last = Counting(), set[int]()
    remembered = RememberedMap(counting)
    for chosen in rows:
        at, before = places[np.array(chosen, dtype=np.int64)], counting.fields
        own_field, own_gradient = Counting().field_and_gradient(at)
        for again in (False, True):
            field, gradient = remembered.field_and_gradient(at)
            np.testing.assert_array_equal(field, own_field)
            np.testing.assert_array_equal(gradient, own_gradient)
            field[:], gradient[:] = np.nan, np.nan  # whoever asked may do what it likes with them
            if not again:
                assert counting.fields - before == sum(row not in last for row in chosen)
                last = set(chosen) if counting.fields > before else last
        assert counting.fields - before <= len(chosen)


def test_fields_of_a_query_are_those_inside() -> None:
    """Outside a query says nothing where the field itself goes on."""
    counting = Counting()
    remembered = RememberedMap(counting)
    places = np.random.default_rng(0).normal(size=(31, 3))
    remembered.query(places)
    field, gradient = remembered.field_and_gradient(places)
    own_field, own_gradient = Counting().field_and_gradient(places)
    np.testing.assert_array_equal(field, own_field)
    np.testing.assert_array_equal(gradient, own_gradient)
    assert 0 < counting.fields == (places[:, 0] <= 0).sum()


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond it all is forgotten, and answers stay right."""
    monkeypatch.setattr(view, "MOST", 10)
    counting = Counting()
    remembered = RememberedMap(counting)
    places = np.random.default_rng(0).normal(size=(12, 3))
    for at in (places[:8], places[4:], places[:8]):
        np.testing.assert_array_equal(remembered.query(at).variance, at**2)
    assert counting.asked == 24


def test_it_knows_of_errors_what_the_map_does() -> None:
    """A map that does not know how its errors are correlated does not learn it so."""
    assert not isinstance(RememberedMap(Counting()), UncertainMap)


def test_threads_may_ask_at_once() -> None:
    """Many questions from four threads, places in common: each gets its own answer."""
    places = np.random.default_rng(0).normal(size=(400, 3))
    chosen = [np.random.default_rng(seed).permutation(400)[:150] for seed in range(60)]
    counting = Counting()
    remembered = RememberedMap(counting)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda at: remembered.query(places[at]), chosen))
    for at, each in zip(chosen, found, strict=True):
        np.testing.assert_array_equal(each.variance, places[at] ** 2)
    assert counting.asked <= 400


def test_it_goes_to_another_process_without_its_memory() -> None:
    remembered = RememberedMap(Counting())
    remembered.query(np.ones((2, 3)))
    there = pickle.loads(pickle.dumps(remembered))  # noqa: S301  our own, a moment ago
    np.testing.assert_array_equal(there.query(np.ones((1, 3))).variance, np.ones((1, 3)))


class Knowing(Counting):
    """The same with what some maps know beside it."""

    errors_over_stated = 1.5

    def errors_over(self, points: FloatArray, /) -> FloatArray:
        return points


def test_what_its_map_has_is_there_for_a_static_look() -> None:
    """Since Python 3.12 ``isinstance`` with a protocol does not ask ``__getattr__``."""
    for known, expected in ((Knowing(), True), (Counting(), False)):
        remembered = RememberedMap(known)
        for name in ("errors_over", "errors_over_stated"):
            found = getattr_static(remembered, name, None)
            assert (found is not None) is expected
        assert isinstance(remembered, UncertainMap) is expected
