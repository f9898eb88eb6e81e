"""Drives on which one thing is wrong that a specialist would name, in a small exact world."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import (
    Distortion,
    FieldSeries,
    FloatArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from tests.drives.degenerate import POSTS, STRONG, World, eight, mounted, straight
from tests.worlds.exact import dipole_world, exact_reading

NOISE = 0.1
PLACES = np.array([[0.2, -0.1, 0.15], [-0.3, 0.25, 0.1], [0.1, 0.3, -0.1]])
SENSORS = mounted(PLACES)
NOMINAL = {f"mag_{k}": (x, y, z) for k, (x, y, z) in enumerate(PLACES.tolist())}
EIGHT = eight()


@dataclass(frozen=True)
class Drive:
    """What is calibrated: a recording, the map, and where sensors are meant to be."""

    recording: Recording
    field_map: World
    options: CalibrationOptions


def drive(
    trajectory: Trajectory = EIGHT,
    sensors: tuple[KnownSensor, ...] = SENSORS,
    place: World = STRONG,
    field_map: World = STRONG,
) -> Drive:
    """Return a drive through a place with a map that may be of another."""
    rng = np.random.default_rng(7)
    series = tuple(read(each, trajectory, place, rng) for each in sensors)
    recording = Recording(trajectory, series, SourceFile("drive.bag", "ab12"))
    return Drive(recording, field_map, CalibrationOptions(start=NOMINAL))


def read(
    sensor: KnownSensor, trajectory: Trajectory, place: World, rng: np.random.Generator
) -> FieldSeries:
    """Return what a sensor reads along a drive, with noise."""
    field = exact_reading(place, sensor, trajectory.R, trajectory.p)
    field = field + rng.normal(0, NOISE, field.shape)
    return FieldSeries(sensor.sensor, "/m", "m", trajectory.stamp_ns, field)


def with_sensor(index: int, sensor: KnownSensor) -> tuple[KnownSensor, ...]:
    """Return the sensors with one that is different."""
    return tuple(sensor if k == index else each for k, each in enumerate(SENSORS))


def distorted(index: int, C: FloatArray, H: FloatArray) -> tuple[KnownSensor, ...]:
    """Return the sensors with ``C @`` the C of one, and another H."""
    old = SENSORS[index]
    return with_sensor(index, replace(old, distortion=Distortion(C @ old.distortion.C, H)))


def with_series(whole: Drive, index: int, field: FloatArray) -> Drive:
    """Return a drive on which one sensor read something else, shape (N, 3)."""
    series = list(whole.recording.series)
    series[index] = replace(series[index], field=field)
    return replace(whole, recording=replace(whole.recording, series=tuple(series)))


def good() -> Drive:
    """Nothing is wrong."""
    return drive()


def dead_axis() -> Drive:
    """The z axis of a sensor reports its noise only."""
    whole = drive()
    field = whole.recording.series[1].field.copy()
    field[:, 2] = np.random.default_rng(1).normal(0.3, 0.05, len(field))
    return with_series(whole, 1, field)


def changed_place() -> Drive:
    """Steel was put beside the way after the survey."""
    steel = STRONG.with_dipoles(np.array([2.0, 1.5, 0.0]), np.array([15.0, 10.0, 20.0]))
    return drive(place=steel)


def short() -> Drive:
    """The vehicle stopped after a few metres."""
    return drive(EIGHT[np.arange(60)])


def straight_line() -> Drive:
    """One heading, level ground, a field that is the same at all heights."""
    return drive(straight(), place=POSTS, field_map=POSTS)


def late() -> Drive:
    """The sensors' clocks are off by 40 ms."""
    whole = drive()
    series = tuple(
        replace(each, stamp_ns=each.stamp_ns - 40_000_000) for each in whole.recording.series
    )
    return replace(whole, recording=replace(whole.recording, series=series))


def loose(share: float = 0.5) -> Drive:
    """A sensor moves by 3 cm and turns by 3 degrees on the way."""
    whole, old = drive(), SENSORS[1]
    turn = Rotation.from_rotvec([0.0, 0.03, 0.05]).as_matrix()
    moved = KnownSensor(
        old.sensor,
        old.t_lidar_mag + np.array([0.03, 0.0, -0.01]),
        Distortion(turn @ old.distortion.C, old.distortion.H),
    )
    after = read(moved, EIGHT, STRONG, np.random.default_rng(8)).field
    field = whole.recording.series[1].field.copy()
    first = round(share * len(field))
    field[first:] = after[first:]
    return with_series(whole, 1, field)


def swapped_axes() -> Drive:
    """A driver publishes y as x and x as y."""
    swap = np.eye(3)[[1, 0, 2]]
    return drive(sensors=distorted(1, swap, SENSORS[1].distortion.H))


def turned_axes() -> Drive:
    """A driver publishes y as x and -x as y, or the sensor is turned by 90 degrees."""
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return drive(sensors=distorted(1, turn, SENSORS[1].distortion.H))


def magnet() -> Drive:
    """A magnet was put on the vehicle after the survey."""
    return drive(sensors=distorted(1, np.eye(3), np.array([60.0, -80.0, 30.0])))


def map_elsewhere() -> Drive:
    """The map is that of another hall."""
    return drive(place=dipole_world(77, 15))


def swapped_sensors() -> Drive:
    """Two sensors have each other's topic."""
    first, second = SENSORS[0], SENSORS[1]
    sensors = (
        replace(first, t_lidar_mag=second.t_lidar_mag),
        replace(second, t_lidar_mag=first.t_lidar_mag),
        SENSORS[2],
    )
    return drive(sensors=sensors)
