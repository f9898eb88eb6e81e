"""A calibration on an exact map, and other drives to validate it on."""

from dataclasses import replace
from functools import cache

import numpy as np

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.records.calibration import CalibrationResult
from tests.drives.degenerate import COUNT, STRONG, World, at_height, poses
from tests.drives.verdict import EIGHT, NOMINAL, SENSORS, drive, read

OPTIONS = CalibrationOptions(start=NOMINAL)
MAP = SourceFile("map.npz", "cd34")


@cache
def calibrated() -> CalibrationResult:
    """Calibrate three sensors on an eight through a strong field."""
    first = drive(EIGHT)
    return calibrate(first.recording, first.field_map, first.options)


def loops(seed: int = 1) -> Trajectory:
    """Another drive through the place than the one of the calibration."""
    rng, s = np.random.default_rng([seed, 50]), np.linspace(0, 1, COUNT)
    x, y = (
        2.2 * np.sin(a * s + b) + 0.8 * np.sin(2 * a * s + c)
        for a, b, c in rng.uniform([5, 0, 0], [9, 6, 6], (2, 3))
    )
    return poses(10 * s + rng.uniform(0, 6), at_height(x, y, 0.1), 0.15, 0.15)


def other_drive(sensors: tuple[KnownSensor, ...] = SENSORS, place: World = STRONG) -> Recording:
    """Return what sensors read on another drive, with noise of its own."""
    rng, trajectory = np.random.default_rng([1, 51]), loops(1)
    series = tuple(read(each, trajectory, place, rng) for each in sensors)
    return Recording(trajectory, series, SourceFile("other.bag", "ef56"))


def changed(
    index: int,
    t: FloatArray | None = None,
    C: FloatArray | None = None,
    H: FloatArray | None = None,
) -> tuple[KnownSensor, ...]:
    """Return the sensors with one moved by t in m, turned by ``C @``, and offset by H in uT."""
    old = SENSORS[index]
    distortion = Distortion(
        (np.eye(3) if C is None else C) @ old.distortion.C,
        old.distortion.H + (0.0 if H is None else H),
    )
    new = replace(
        old, t_lidar_mag=old.t_lidar_mag + (0.0 if t is None else t), distortion=distortion
    )
    return tuple(new if k == index else each for k, each in enumerate(SENSORS))
