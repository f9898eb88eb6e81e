"""What a map is asked anew along a drive, and what is remembered."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.calibration.coverage import NothingShared, UncertainMap, errors_over_stated
from l2m_gtsam.calibration.view import REOBSERVE_M
from l2m_gtsam.data import FieldSample, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import masked
from l2m_gtsam.validation.map_along_drive import MOST, NEAR_M, MapAlongDrive, along_drive
from tests.worlds.counting import Counting

PLACES = np.random.default_rng(0).uniform([0.2, 0.2, 0.2], [1.8, 0.8, 0.8], (40, 3))
BORDER = 1.0  # between two tiles along x, metres
SEEDS = st.integers(0, 10_000)


class Errors(NothingShared):
    """Errors of a map that are told apart by the places that they were asked for."""

    def __init__(self, points: FloatArray) -> None:
        self.points = points

    def sizes(self) -> dict[int, int]:
        return {0: len(self.points)}


class Knowing(Counting):
    """The same of a map of two tiles that knows its errors."""

    errors_over_stated = 1.5

    def __init__(self) -> None:
        super().__init__()
        self.errors_asked = 0

    def errors_over(self, points: FloatArray, /) -> Errors:
        self.errors_asked += 1
        return Errors(points)

    def tile_of(self, points: FloatArray, /) -> IntArray:
        return (points[:, 0] > BORDER).astype(np.int64)

    def weights_in(self, tile: int, points: FloatArray, /) -> int:
        return len(points)


class Masking(Knowing):
    """The same, which says nothing where it has no data."""

    def query(self, points: FloatArray, /) -> FieldSample:
        return masked(super().query(points))


def moved(by: float, seed: int = 1) -> FloatArray:
    """Return the places, each moved by so many metres anywhere but into the other tile."""
    step = np.random.default_rng(seed).normal(size=PLACES.shape)
    step *= by / np.linalg.norm(step, axis=1)[:, None]
    step[:, 0] *= np.where((PLACES + step > BORDER)[:, 0] == (PLACES > BORDER)[:, 0], 1, -1)
    return np.asarray(PLACES + step)


@settings(max_examples=30)
@given(SEEDS, st.floats(0, 0.99))
def test_errors_of_places_near_by_are_remembered(seed: int, share: float) -> None:
    """Of all of them, and of some in the same tiles."""
    asked = Knowing()
    along = MapAlongDrive(asked)
    first = along.errors_over(PLACES)
    again = moved(share * NEAR_M, seed)
    assert along.errors_over(again) is first
    assert along.errors_over(again[::2]) is first
    assert asked.errors_asked == 1


def test_errors_of_places_further_away_are_asked_anew() -> None:
    """Already where a single one is."""
    asked = Knowing()
    along = MapAlongDrive(asked)
    first, one = along.errors_over(PLACES), PLACES.copy()
    one[7, 2] = 0.8 + 1.01 * NEAR_M
    assert along.errors_over(one) is not first
    assert along.errors_over(moved(5 * NEAR_M)) is not first
    assert asked.errors_asked == 3


@pytest.mark.parametrize("places", [PLACES[PLACES[:, 0] < BORDER], PLACES[:1]])
def test_errors_in_other_tiles_are_asked_anew(places: FloatArray) -> None:
    """Whether there is one more tile or one less."""
    for known, wanted in ((PLACES, places), (places, PLACES)):
        asked = Knowing()
        along = MapAlongDrive(asked)
        first = along.errors_over(known)
        assert along.errors_over(wanted) is not first
        assert asked.errors_asked == 2


def test_a_step_into_another_tile_is_asked_anew() -> None:
    """Even by a millimetre."""
    asked = Knowing()
    along, beside = MapAlongDrive(asked), np.array([[BORDER - 5e-4, 0.5, 0.5]])
    first = along.errors_over(beside)
    assert along.errors_over(beside + np.array([1e-3, 0, 0])) is not first
    assert asked.errors_asked == 2


def test_of_several_errors_those_of_the_fewest_numbers_are_taken() -> None:
    """Those of one sensor rather than those of all."""
    along = MapAlongDrive(Knowing())
    few = along.errors_over(PLACES[::2])
    every = along.errors_over(PLACES)
    assert every is not few
    assert along.errors_over(PLACES[::2]) is few
    assert along.errors_over(PLACES) is every


def test_the_memory_of_errors_is_bounded() -> None:
    asked = Knowing()
    along = MapAlongDrive(asked)
    for k in range(MOST + 1):
        along.errors_over(PLACES + np.array([0, 0, 10.0 * k]))
    along.errors_over(PLACES)
    assert asked.errors_asked == MOST + 2


@settings(max_examples=30)
@given(SEEDS, st.floats(0, 0.99))
def test_the_variance_near_by_is_remembered_and_the_field_is_not(seed: int, share: float) -> None:
    asked, again = Knowing(), moved(share * REOBSERVE_M, seed)
    along = MapAlongDrive(asked)
    first, second = along.query(PLACES), along.query(again)
    field, gradient = Counting().field_and_gradient(again)
    np.testing.assert_array_equal(first.variance, PLACES**2)
    np.testing.assert_array_equal(second.field, field)
    np.testing.assert_array_equal(second.gradient, gradient)
    away = np.linalg.norm(again[:, None] - PLACES, axis=2)
    np.testing.assert_array_equal(second.variance, PLACES[away.argmin(axis=1)] ** 2)
    assert asked.asked == len(PLACES)


def test_the_variance_further_away_is_asked_anew() -> None:
    """Of those places alone."""
    asked, again = Knowing(), PLACES.copy()
    along = MapAlongDrive(asked)
    along.query(PLACES)
    again[:5, 2] += 10.0
    np.testing.assert_array_equal(along.query(again).variance, again**2)
    assert asked.asked == len(PLACES) + 5


def test_nothing_is_said_outside_of_the_map() -> None:
    """When asked first, and when remembered; the world has data where x is positive."""
    asked = Masking()
    along, places = MapAlongDrive(asked), PLACES - np.array([1.0, 0, 0])
    for _ in range(2):
        found, own = along.query(places), Masking().query(places)
        for name in ("field", "gradient", "variance", "inside"):
            np.testing.assert_array_equal(getattr(found, name), getattr(own, name))
    assert asked.asked == len(places)


def test_places_that_are_none_are_refused_as_the_map_does() -> None:
    along, places = MapAlongDrive(Knowing()), np.full((1, 3), np.nan)
    for ask in (along.query, along.errors_over):
        with pytest.raises(MapError, match="not finite"):
            ask(places)
    assert len(along.query(np.empty((0, 3))).inside) == 0


def test_a_drive_does_not_see_another_s_memory() -> None:
    asked = Knowing()
    for count in (1, 2):
        along_drive(asked).query(PLACES)
        assert asked.asked == count * len(PLACES)


def test_it_knows_of_errors_what_the_map_does() -> None:
    """A map that does not know how its errors are correlated is left as it is."""
    plain, along = Counting(), along_drive(Knowing())
    assert along_drive(plain) is plain
    assert isinstance(along, UncertainMap)
    assert errors_over_stated(along) == 1.5


def test_it_goes_to_another_process_without_its_memory() -> None:
    along = MapAlongDrive(Knowing())
    along.query(PLACES)
    there = pickle.loads(pickle.dumps(along))  # noqa: S301  our own, a moment ago
    np.testing.assert_array_equal(there.query(PLACES).variance, PLACES**2)
