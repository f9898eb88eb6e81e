"""Surveys of an office corridor, and drives to and fro in it."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Trajectory
from l2m_gtsam.simulate.hall_drives import LIDAR_M, STEP_NS, CalibrationDrive
from l2m_gtsam.simulate.office_corridor import (
    FREE_WIDTH,
    HALF_LENGTH,
    OfficeCorridor,
)

LANES = 6  # of a survey at one height
REACH = np.array([HALF_LENGTH - 0.5, FREE_WIDTH - 0.3])  # of the lidar from the middle, metres
ROCK = 0.02  # radians, standard deviation about x and y: the vehicle has springs
MOUNTED = np.array([0.28, 0.28])  # of sensors from the lidar along x and y, metres


def survey_way(
    office: OfficeCorridor, seed: int, heights: tuple[float, ...], count: int
) -> FloatArray:
    """Return the places of a survey, shape (N, 3): lanes to and fro at each height by turns."""
    rng, passes = np.random.default_rng([seed, 23]), []
    for height in heights:
        u = np.linspace(0, LANES, -(-count // len(heights)), endpoint=False)
        lane = np.floor(u)
        sweep = np.where(lane % 2, 1 - (u - lane), u - lane)
        x = HALF_LENGTH * (2 * sweep - 1)
        across = (lane + rng.uniform(0.3, 0.7)) / LANES * 2 - 1
        # A trolley that is pushed by hand sways.
        y = FREE_WIDTH * across + 0.06 * np.sin(1.7 * x + rng.uniform(-np.pi, np.pi) + lane)
        y = np.clip(y, -FREE_WIDTH, FREE_WIDTH)
        passes.append(np.column_stack([x, y, height + office.height(np.column_stack([x, y]))]))
    return np.concatenate(passes)


def office_drive(
    office: OfficeCorridor,
    seed: int,
    span: tuple[float, float],
    noise: float,
    sensors: int,
    count: int,
) -> CalibrationDrive:
    """Return a drive of a vehicle with sensors at heights within ``span`` over the floor.

    It goes to and fro with swerves, turns where it likes, and rocks. Of each sensor there are
    ``count`` readings, with a noise in uT, where it is away from the walls.
    """
    rng = np.random.default_rng([seed, 25])
    poses = poses_of(office, rng, 10 * count)
    known = tuple(mounted_sensor(rng, index, span) for index in range(sensors))
    return CalibrationDrive.along(poses, known, office.free, office.field, noise, count, rng)


def poses_of(office: OfficeCorridor, rng: np.random.Generator, count: int) -> Trajectory:
    """Return poses of the lidar along a closed path."""
    u = 2 * np.pi * np.arange(count) / count
    laps = int(rng.integers(2, 4))
    x = np.cos(laps * u + rng.uniform(-np.pi, np.pi)) + 0.25 * _swerves(rng, u, 5, 12)
    y = _swerves(rng, u, laps, 14)
    xy = np.column_stack([each / np.abs(each).max() for each in (x, y)]) * REACH
    ahead = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    up = office.normal(xy)
    forward = np.column_stack([ahead, np.zeros(count)])
    forward -= np.sum(forward * up, axis=1, keepdims=True) * up
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    R = np.stack([forward, np.cross(up, forward), up], axis=2)
    rock = np.column_stack([_swerves(rng, u, 20, 40), _swerves(rng, u, 20, 40), np.zeros(count)])
    rock *= ROCK / np.maximum(rock.std(axis=0), 1e-12)
    R = R @ Rotation.from_rotvec(rock).as_matrix()
    p = np.column_stack([xy, LIDAR_M + office.height(xy)])
    return Trajectory(STEP_NS * np.arange(count), R, p, "map", "lidar")


def _swerves(rng: np.random.Generator, u: FloatArray, low: int, high: int) -> FloatArray:
    """Return a sum of waves of whole numbers of turns, shape (N,)."""
    turns = np.arange(low, high)
    phase, size = rng.uniform(-np.pi, np.pi, len(turns)), rng.standard_normal(len(turns))
    return np.asarray(np.sin(u[:, None] * turns + phase) @ (size / np.sqrt(turns)))


def mounted_sensor(rng: np.random.Generator, index: int, span: tuple[float, float]) -> KnownSensor:
    """Return a sensor beside the lidar, at a height within a span, with iron of its own."""
    place = np.append(rng.uniform(-MOUNTED, MOUNTED), rng.uniform(*span) - LIDAR_M)
    turn = Rotation.from_euler("xyz", rng.normal(0, [4.0, 4.0, 8.0]), degrees=True).as_matrix()
    C = (np.eye(3) + 0.04 * rng.standard_normal((3, 3))) @ turn
    return KnownSensor(f"mag_{index:02d}", place, Distortion(C, 15 * rng.standard_normal(3)))
