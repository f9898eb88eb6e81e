"""Starts without a guess: found from metres away, told apart, and honest where they are not."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.start.candidates import Candidates
from l2m_gtsam.calibration.start.descent import Basin
from l2m_gtsam.calibration.start.global_start import (
    StartOptions,
    distinct,
    find_starts,
    find_starts_around,
    spread_out,
)
from l2m_gtsam.data import FieldSample, FloatArray, Readings
from l2m_gtsam.maps.sliding_gp import SlidingGP
from l2m_gtsam.records.calibration import FoundStart
from tests.drives.start_search import NEAR, OPTIONS, PERIOD, SENSORS, WORLD, corridor, together
from tests.worlds.exact import drive


def errors(found: list[FoundStart | None]) -> FloatArray:
    starts = [each.t_lidar_mag for each in found if each is not None]
    truth = [sensor.t_lidar_mag for sensor in SENSORS]
    return np.asarray(np.linalg.norm(np.array(starts) - np.array(truth), axis=1))


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (2.0, -2.0, 0.5), (-1.6, 1.6, -1.6)])
def test_starts_are_found_from_three_metres_away(centre: tuple[float, float, float]) -> None:
    found = find_starts(together(), WORLD, np.array(centre), OPTIONS)
    assert errors(found).max() < NEAR
    assert min(each.margin for each in found if each) > OPTIONS.clear


def test_the_survey_itself_is_map_enough_to_look_on() -> None:
    """The nearest of 8,000 noisy readings leads to the right basin of the paper's map."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-5.5, -5.5, 0.0], [5.5, 5.5, 1.0], (8000, 3))
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = SlidingGP.fit(points, field)
    found = find_starts(together(), ours, np.array([1.0, -1.0, 0.3]), OPTIONS)
    assert errors(found).max() < OPTIONS.step


def test_sensors_that_share_no_pose_are_looked_for_one_by_one() -> None:
    readings = drive(2, SENSORS, WORLD, count=400, noise=0.2)
    near = OPTIONS.model_copy(update={"search_radius": 2.0})
    found = find_starts(readings, WORLD, np.array([1.0, 1.0, 0.2]), near)
    assert errors(found).max() < NEAR


# Around two of these lies what another one holds too, around the last one nothing of the map.
CENTRES = np.array([[0.3, 0.1, 0.0], [0.6, -0.4, 0.3], [-1.0, 0.7, 0.1], [40.0, 0.0, 0.0]])
SMALL = StartOptions(poses=30, search_radius=1.2)


def surveyed() -> SlidingGP:
    """Return a map that ends some metres from the drive."""
    points = np.random.default_rng(1).uniform([-5.5, -5.5, 0.0], [5.5, 5.5, 1.0], (3000, 3))
    return SlidingGP.fit(points, WORLD.field_and_gradient(points)[0])


def test_several_searches_at_once_find_what_each_finds_alone() -> None:
    readings, field_map = together(), surveyed()
    # One sensor has times of its own.
    late = replace(readings, stamp_ns=readings.stamp_ns + 10_000_000 * (readings.sensor == 1))
    at_once = find_starts_around(late, field_map, CENTRES, SMALL)
    assert at_once[3] == [None] * 3
    for centre, found in zip(CENTRES, at_once, strict=True):
        for one, other in zip(find_starts(late, field_map, centre, SMALL), found, strict=True):
            if one is None or other is None:
                assert one is other
                continue
            # A map may round otherwise when it is asked for more places.
            np.testing.assert_allclose(one.t_lidar_mag, other.t_lidar_mag, rtol=0, atol=1e-9)
            assert one.margin == pytest.approx(other.margin, rel=1e-9)
            assert (one.runner_up is None) == (other.runner_up is None)
            if one.runner_up is not None and other.runner_up is not None:
                np.testing.assert_allclose(one.runner_up, other.runner_up, rtol=0, atol=1e-9)


def test_overlapping_searches_look_at_the_same_places() -> None:
    """A sensor well inside both balls is found at one place, not at two that are near."""
    readings, centres = together(), np.array([[0.31, -0.17, 0.08], [-0.24, 0.05, -0.33]])
    near = OPTIONS.model_copy(update={"search_radius": 1.5})
    first, second = (find_starts(readings, WORLD, centre, near) for centre in centres)
    for one, other in zip(first, second, strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.t_lidar_mag, other.t_lidar_mag, rtol=0, atol=1e-9)


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0.1, 1.0), st.floats(0.3, 1.0))
def test_candidates_are_the_multiples_of_the_step_in_the_ball(
    centre: tuple[float, float, float], step: float, radius: float
) -> None:
    middle = np.array(centre)
    ball = Candidates.around(middle, radius, step)
    axis = np.arange(-np.ceil(2 / step), np.ceil(2 / step) + 1)
    every = step * np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = every[np.linalg.norm(every - middle, axis=1) <= radius]
    np.testing.assert_array_equal(ball.t(np.argwhere(ball.within)), expected)


def test_a_union_holds_its_balls_and_nothing_else() -> None:
    balls = [Candidates.around(centre, SMALL.search_radius, SMALL.step) for centre in CENTRES[:3]]
    union = Candidates.union(balls)
    held = [ball.t(np.argwhere(ball.within)) for ball in balls]
    expected = np.unique(np.concatenate(held), axis=0)
    np.testing.assert_array_equal(union.t(np.argwhere(union.within)), expected)
    for ball in balls:
        box = union.t(np.argwhere(np.ones_like(union.within))).reshape(*union.within.shape, 3)
        part = box[ball.slices_of(union)]
        np.testing.assert_array_equal(part[ball.within], ball.t(np.argwhere(ball.within)))


@given(st.integers(0, 40), st.floats(0.1, 1.5), st.integers(1, 8))
def test_places_are_spread_out_one_after_the_other(count: int, apart: float, most: int) -> None:
    places = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    picked: list[int] = []
    for row, place in enumerate(places):
        if len(picked) < most and all(np.linalg.norm(place - places[p]) >= apart for p in picked):
            picked.append(row)
    assert spread_out(places, apart, most) == picked


def test_a_field_that_repeats_itself_is_ambiguous() -> None:
    """Driven without turning, a sensor a period ahead reads the same."""
    n, t, world = 300, np.array([0.3, 0.0, 0.1]), corridor()
    rng = np.random.default_rng(0)
    p = np.column_stack([np.linspace(0, 12, n), rng.normal(0, 0.1, n), rng.normal(0.3, 0.1, n)])
    z = world.field_and_gradient(p + t)[0] + rng.normal(0, 0.1, p.shape)
    R, alone = np.tile(np.eye(3), (n, 1, 1)), np.zeros(n, dtype=np.int64)
    readings = Readings(("a",), alone, 50_000_000 * np.arange(n), R, p, z)
    near = OPTIONS.model_copy(update={"search_radius": 2.5, "poses": 40})
    (found,) = find_starts(readings, world, np.zeros(3), near)
    assert found is not None
    assert found.runner_up is not None
    assert found.margin < OPTIONS.clear
    away = found.runner_up - found.t_lidar_mag
    np.testing.assert_allclose(np.abs(away), [PERIOD, 0, 0], atol=0.1)


def test_readings_that_repeat_nothing_have_no_second_place() -> None:
    found = find_starts(together(), WORLD, np.zeros(3), OPTIONS.model_copy(update={"follow": 1.0}))
    for each in found:
        assert each is not None
        assert each.margin > 1


@dataclass(frozen=True)
class Elsewhere:
    """A map that covers nothing of the drive."""

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))

    def query(self, points: FloatArray) -> FieldSample:
        unknown = np.full((len(points), 3), np.inf)
        inside = np.zeros(len(points), dtype=np.bool_)
        return FieldSample(*self.field_and_gradient(points), unknown, inside)


def test_outside_of_the_map_nothing_is_found() -> None:
    assert find_starts(together(), Elsewhere(), np.zeros(3), OPTIONS) == [None] * 3


def test_a_silent_sensor_has_no_start() -> None:
    readings = together()
    heard = readings.select(readings.sensor != 1)
    found = find_starts(heard, WORLD, np.zeros(3), OPTIONS)
    assert found[1] is None
    assert found[0] is not None
    assert found[2] is not None


def test_basins_near_each_other_are_one() -> None:
    a = Basin(np.zeros(3), 1.0)
    b, c = replace(a, t=np.array([0.1, 0, 0]), rms=0.5), replace(a, t=np.ones(3), rms=2.0)
    assert distinct([a, b, c], 0.2) == (b, c)
