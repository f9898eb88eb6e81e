"""The global start beside the rest of the solve, on a clean drive and with wrong readings."""

from dataclasses import replace
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.dipole_hall import NOISE, compiled_map, hall
from benchmarks.timing import seconds
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.calibration.start.global_start import StartOptions, find_starts
from l2m_gtsam.data import FloatArray, KnownSensor, Readings, Trajectory
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap
from l2m_gtsam.records.calibration import FoundStart
from tests.worlds.exact import DipoleWorld, drive, random_sensors, read_together

SENSORS, READINGS = 12, 2_000
WRONG = 0.1  # share of the readings, off by 50 uT and more


def report() -> Table:
    """Return costs and errors."""
    world, sensors = hall(1), random_sensors(1, SENSORS)
    field_map = compiled_map(world)
    clean = array_drive(sensors, world)
    truth = np.stack([sensor.t_lidar_mag for sensor in sensors])
    table = Table("drive", "start (s)", "rest of the solve (s)", "start off (mm)", "solve off (mm)")
    for name, readings in {"clean": clean, "a tenth wrong": spoiled(clean)}.items():
        places = starts(readings, field_map)  # loads compiled code, and compiles tiles
        before = seconds(partial(starts, readings, field_map))
        solution = solve_one_key(readings, field_map, places, OneKeyOptions())
        solve = partial(solve_one_key, readings, field_map, places, OneKeyOptions())
        after = seconds(solve, 1)
        off = [rms(found - truth) for found in (places, solution.estimate.t)]
        table.add_row(name, f"{before:.2f}", f"{after:.2f}", *(f"{1e3 * each:.1f}" for each in off))
    return table


def array_drive(sensors: tuple[KnownSensor, ...], world: DipoleWorld) -> Readings:
    """Return what an array reads together: all sensors at the same poses."""
    path = drive(2, sensors[:1], world, count=READINGS)
    poses = Trajectory(path.stamp_ns, path.R_map_lidar, path.p_map_lidar, "map", "lidar")
    return read_together(sensors, world, poses, np.random.default_rng(4), NOISE)


def starts(readings: Readings, field_map: CompiledMap) -> FloatArray:
    """Return where the sensors are found, shape (S, 3), metres."""
    found = find_starts(readings, field_map, np.zeros(3), StartOptions())
    return np.stack([each.t_lidar_mag for each in found if isinstance(each, FoundStart)])


def spoiled(readings: Readings) -> Readings:
    """Return readings of which a tenth is wrong by far."""
    rng = np.random.default_rng(3)
    field = readings.field.copy()
    wrong = rng.random(len(field)) < WRONG
    field[wrong] += 50 * rng.standard_normal((int(wrong.sum()), 3))
    return replace(readings, field=field)


def rms(offsets: FloatArray) -> float:
    """Return the root mean square length of offsets, shape (S, 3)."""
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))


if __name__ == "__main__":
    Console().print(report())
