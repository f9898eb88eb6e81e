"""H that follows the vehicle's motion: its numbers are the vehicle's, however the lidar sits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.budget.looked_for import (
    MotionUnits,
    MovingParts,
    motion_numbers,
    processes,
)
from l2m_gtsam.data import LidarMotion
from l2m_gtsam.records.error_budget import DisturbanceKind
from tests.support.scenes import scene

COUNT = 60
PLACES = scene(np.linspace(0.0, 30.0, COUNT))
ROWS = np.arange(COUNT)


def motion(seed: int) -> LidarMotion:
    rng = np.random.default_rng(seed)
    return LidarMotion(rng.normal(size=(COUNT, 6)), rng.normal(size=(COUNT, 6)), np.zeros(COUNT))


def test_numbers_do_not_depend_on_how_the_lidar_is_mounted() -> None:
    R, moving = PLACES.readings.R_map_lidar, motion(1)
    mount = Rotation.from_euler("xyz", [20, -70, 130], degrees=True).as_matrix()
    both = np.kron(np.eye(2), mount)
    twist, growth = moving.twist_lidar @ both, moving.acceleration_lidar @ both
    turned = LidarMotion(twist, growth, moving.offset)
    np.testing.assert_allclose(
        motion_numbers(R @ mount, turned), motion_numbers(R, moving), atol=1e-12
    )


def test_numbers_are_those_of_the_way() -> None:
    """Turning by 0.3 rad/s, at 2 m/s along y of the lidar, slower by 0.5 m/s each second."""
    twist = np.tile([0, 0, 0.3, 0, 2.0, 0], (COUNT, 1))
    growth = np.tile([0, 0, 0, 0.9, -0.5, 0], (COUNT, 1))
    level = np.tile(np.eye(3), (COUNT, 1, 1))
    numbers = motion_numbers(level, LidarMotion(twist, growth, np.zeros(COUNT)))
    np.testing.assert_allclose(
        numbers, [[0.3, 0.3 / np.sqrt(0.3**2 + 2.0**2 + 0.01), 2.0, -0.5]] * COUNT, atol=1e-12
    )
    at_rest = motion_numbers(level, LidarMotion.steady(np.zeros((COUNT, 6))))
    np.testing.assert_array_equal(at_rest, 0.0)


def test_features_add_to_the_readings_along_their_axes() -> None:
    readings = replace(PLACES.readings, motion=motion(2))
    vehicle = MotionUnits.over(readings, motion(2))
    values = vehicle.values(readings, ROWS)
    np.testing.assert_allclose(values.std(axis=0), 1.0)
    found = MovingParts(replace(PLACES, readings=readings), 0, vehicle)
    added = PLACES.C @ found.features(ROWS)
    along = np.einsum("nk,ia->nika", values, np.eye(3)).reshape(COUNT, 3, 12)
    np.testing.assert_allclose(added, along, atol=1e-12)
    expected = {"turning_ut": 0.2, "steering_ut": 0.0, "speed_ut": 0.1, "acceleration_ut": 0.5}
    names = found.named(0, np.array([0.04, 0.0, 0.01, 0.25]))
    assert names == pytest.approx(expected)


def test_what_does_not_vary_adds_nothing() -> None:
    steady = LidarMotion.steady(np.tile([0, 0, 0, 1.0, 0, 0], (COUNT, 1)))
    readings = replace(PLACES.readings, motion=steady)
    values = MotionUnits.over(readings, steady).values(readings, ROWS)
    np.testing.assert_array_equal(values, 0.0)


def test_other_readings_have_the_units_of_the_drive() -> None:
    readings = replace(PLACES.readings, motion=motion(3))
    vehicle = MotionUnits.over(readings, motion(3))
    every = MovingParts(replace(PLACES, readings=readings), 0, vehicle)
    part = np.arange(10, 25)
    few = scene(np.linspace(0.0, 30.0, COUNT))
    few = replace(few, readings=readings[part], C=few.C[part])
    np.testing.assert_allclose(every.on(few).features(np.arange(15)), every.features(part))


def test_it_is_looked_for_where_the_lidar_moves() -> None:
    assert DisturbanceKind.MOVING_PARTS not in {each.kind for each in processes(PLACES, (0,))}
    moving = replace(PLACES, readings=replace(PLACES.readings, motion=motion(4)))
    found = [each for each in processes(moving, (0,)) if isinstance(each, MovingParts)]
    assert [each.sensor for each in found] == [0]
