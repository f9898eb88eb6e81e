"""Starts without a guess: found from metres away, told apart, and honest where they are not."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from l2m_gtsam.data import FieldSample, FloatArray, Readings
from l2m_gtsam.graph.descent import Basin
from l2m_gtsam.graph.global_start import StartOptions, distinct, find_starts
from l2m_gtsam.maps.sliding_gp import SlidingGP
from l2m_gtsam.results import FoundStart
from tests.worlds import DipoleWorld, dipole_world, drive, random_sensors

# The exact field of these worlds is slow to compute: fewer poses, fewer dipoles.
OPTIONS = StartOptions(poses=60)
# What sixty noisy readings know of the place, in metres; from there the solve goes on with all.
NEAR = 0.1
SENSORS = random_sensors(4, 3)
WORLD = dipole_world(4, count=12)


def together(seed: int = 4, noise: float = 0.2, world: DipoleWorld = WORLD) -> Readings:
    """Return what three sensors of one vehicle read, each at poses that all of them share."""
    one = drive(seed, SENSORS[:1], world, count=400)
    rng = np.random.default_rng(seed)
    parts = []
    for sensor in SENSORS:
        places = one.R_map_lidar @ sensor.t_lidar_mag + one.p_map_lidar
        b_map, _ = world.field_and_gradient(places)
        b = np.einsum("kji,kj->ki", one.R_map_lidar, b_map)
        parts.append(sensor.distortion.apply(b) + rng.normal(0, noise, b.shape))
    n, count = len(one), len(SENSORS)
    return Readings(
        tuple(sensor.sensor for sensor in SENSORS),
        np.repeat(np.arange(count), n),
        np.tile(one.stamp_ns, count),
        np.tile(one.R_map_lidar, (count, 1, 1)),
        np.tile(one.p_map_lidar, (count, 1)),
        np.concatenate(parts),
    )


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
    found = find_starts(readings, WORLD, np.array([1.0, 1.0, 0.2]), OPTIONS)
    assert errors(found).max() < NEAR


PERIOD = 2.0  # metres


def corridor() -> DipoleWorld:
    """Return a field that comes again every two metres of the drive's only direction."""
    rng = np.random.default_rng(3)
    cell = rng.uniform([0, -0.8, -0.8], [PERIOD, 0.8, -0.4], (5, 3))
    moments = rng.normal(0, 10, (5, 3))
    shifts = PERIOD * np.arange(-3, 10)[:, None, None] * np.array([1.0, 0.0, 0.0])
    positions = (cell + shifts).reshape(-1, 3)
    return DipoleWorld(np.array([20.0, 0.0, -40.0]), positions, np.tile(moments, (13, 1)))


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
