"""A few readings that stand for all where the map's variance is asked for."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.calibration.view import StandIns, places_of
from tests.worlds.counting import Counting
from tests.worlds.exact import dipole_world, drive, random_sensors


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), count=st.integers(1, 30), most=st.integers(2, 40))
def test_each_has_the_nearest_of_its_own_sensor(seed: int, count: int, most: int) -> None:
    world, sensors = dipole_world(seed), random_sensors(seed, 3)
    readings = drive(seed, sensors, world, count=count)
    stand_ins = StandIns.of(readings, most)
    assert len(stand_ins.few) == 3 * min(most, count)
    np.testing.assert_array_equal(stand_ins.few.sensor[stand_ins.nearest], readings.sensor)
    away = np.abs(stand_ins.few.stamp_ns[stand_ins.nearest] - readings.stamp_ns)
    for s in range(3):
        known = stand_ins.few.stamp_ns[stand_ins.few.sensor == s]
        own = readings.rows_of(s)
        least = np.abs(readings.stamp_ns[own, None] - known).min(axis=1)
        np.testing.assert_array_equal(away[own], least)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_all_readings_stand_for_themselves(seed: int) -> None:
    asked, sensors = Counting(), random_sensors(seed, 2)
    readings = drive(seed, sensors, asked.world, count=20)
    t = np.stack([each.t_lidar_mag for each in sensors])
    told = asked.query(places_of(readings, t))
    found = StandIns.of(readings, 20).sample(readings, asked, t, t)
    for name in ("field", "gradient", "variance", "inside"):
        np.testing.assert_array_equal(getattr(found, name), getattr(told, name))


def test_some_readings_are_asked_for_no_more_places() -> None:
    asked, sensors = Counting(), random_sensors(3, 2)
    readings = drive(3, sensors, asked.world, count=100)
    t, keep = np.stack([each.t_lidar_mag for each in sensors]), np.arange(200) % 2 == 0
    stand_ins = StandIns.of(readings, 10)
    few = stand_ins.select(keep).sample(readings.select(keep), asked, t, t)
    assert asked.asked == 20
    every = stand_ins.sample(readings, asked, t, t).select(keep)
    np.testing.assert_array_equal(few.variance, every.variance)
    np.testing.assert_array_equal(few.field, every.field)
