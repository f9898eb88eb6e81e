"""Surveys, held-out places and calibration drives on the free floor of a steel hall."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, IntArray, KnownSensor, Readings, Trajectory
from l2m_gtsam.simulate.steel_hall import HALF_AREA, SteelHall

CLEARANCE_M = 0.4  # of every reading to posts and racks, horizontally
BODY_M = 0.55  # of the vehicle's middle
LANE_M = 0.4  # from lane to lane of a survey
LIDAR_M = 0.7  # height of the lidar over the floor
STEP_NS = 50_000_000


@dataclass(frozen=True)
class HallSurvey:
    """Readings of an ideal magnetometer in the map frame.

    Attributes
    ----------
    points
        Places in metres, shape (N, 3).
    field
        Readings in uT, shape (N, 3).
    heights
        Of its passes over the floor, in metres.
    noise
        Standard deviation of the readings' noise per axis in uT.
    """

    points: FloatArray
    field: FloatArray
    heights: tuple[float, ...]
    noise: float

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest pass in metres."""
        return min(self.heights), max(self.heights)


@dataclass(frozen=True)
class CalibrationDrive:
    """A drive with readings of sensors whose truth is known.

    Attributes
    ----------
    readings
        With the poses that are known.
    sensors
        The truth.
    trajectory
        All poses that are known.
    offset
        Time offsets of the sensors in seconds, shape (S,).
    """

    readings: Readings
    sensors: tuple[KnownSensor, ...]
    trajectory: Trajectory
    offset: FloatArray

    def truth(self) -> FloatArray:
        """Return t, C row by row, H and time offset of every sensor, shape (S, 16)."""
        return np.column_stack([np.stack([s.vector() for s in self.sensors]), self.offset])


@dataclass(frozen=True)
class Path:
    """Poses of the lidar along a drive: rotations (N, 3, 3) and places (N, 3) in metres."""

    R: FloatArray
    p: FloatArray

    def at(self, t_lidar: FloatArray) -> FloatArray:
        """Return where a point of the lidar frame, shape (3,), comes along, shape (N, 3)."""
        return np.asarray(self.R @ t_lidar + self.p)


def survey(
    hall: SteelHall,
    seed: int,
    heights: tuple[float, ...] = (0.4, 0.7, 1.0),
    noise: float = 0.2,
    count: int = 1500,
) -> HallSurvey:
    """Return a survey in lanes over the whole area, along x and along y by turns.

    Lanes bend around structures. The sensor follows the uneven floor. Slightly
    fewer than ``count`` readings come about where two structures leave no room.
    """
    rng = np.random.default_rng([seed, 3])
    each = -(-count // len(heights))
    passes = [_pass(hall, rng, height, index % 2, each) for index, height in enumerate(heights)]
    points = np.concatenate(passes)
    points = points[hall.free(points, CLEARANCE_M)]
    field = hall.world.field(points) + noise * rng.standard_normal(points.shape)
    return HallSurvey(points, field, heights, noise)


def calibration_drive(
    hall: SteelHall,
    seed: int,
    span: tuple[float, float],
    noise: float = 0.2,
    sensors: int = 1,
    count: int = 300,
) -> CalibrationDrive:
    """Return a drive of a vehicle with sensors at heights within ``span`` over the floor.

    The vehicle follows a closed curve around the structures, heading along it, and pitches,
    rolls and heaves with the floor. Readings nearer than ``CLEARANCE_M`` to a structure or
    outside of the area do not come about: each sensor has ``count`` others.
    """
    rng = np.random.default_rng([seed, 5])
    path = _path(hall, rng, 8 * count)
    mounted = _mounted(rng, span, sensors)
    rows = [_rows(hall, path.at(s.t_lidar_mag), count) for s in mounted]
    fields = [_measured(hall, path, s, r) for s, r in zip(mounted, rows, strict=True)]
    field = np.concatenate(fields) + noise * rng.standard_normal((sensors * count, 3))
    row = np.concatenate(rows)
    readings = Readings(
        tuple(s.sensor for s in mounted),
        np.repeat(np.arange(sensors), count),
        row * STEP_NS,
        path.R[row],
        path.p[row],
        field,
    )
    stamps = STEP_NS * np.arange(len(path.p))
    trajectory = Trajectory(stamps, path.R, path.p, "map", "lidar")
    return CalibrationDrive(readings, mounted, trajectory, np.zeros(sensors))


def _pass(
    hall: SteelHall, rng: np.random.Generator, height: float, along: int, count: int
) -> FloatArray:
    """Return lanes along one axis at one height, shape (count, 3)."""
    width, length = 2 * HALF_AREA[1 - along], 2 * HALF_AREA[along]
    lanes = round(width / LANE_M)
    s = (np.arange(count) + rng.uniform()) / count * lanes  # lane by lane
    # Lanes do not lie at the same place from survey to survey, and waver by a hand's breadth.
    offset = rng.uniform(0.2, 0.8) + 0.1 * np.sin(2 * np.pi * (2 * s + rng.uniform()))
    xy = np.empty((count, 2))
    xy[:, along] = (s % 1 - 0.5) * length
    xy[:, 1 - along] = (np.floor(s) + offset) / lanes * width - width / 2
    xy = hall.pushed(xy, CLEARANCE_M)
    return np.column_stack([xy, height + hall.floor.height(xy)])


def _path(hall: SteelHall, rng: np.random.Generator, count: int) -> Path:
    """Return a closed curve of a few loops over the floor, the vehicle heading along it."""
    order = np.arange(1, 7)
    s = 2 * np.pi * np.arange(count) / count
    weight = rng.standard_normal((2, len(order))) / np.sqrt(order)
    xy = np.sin(s[:, None, None] * order + rng.uniform(-np.pi, np.pi, (2, len(order)))) * weight
    curve = xy.sum(axis=2)
    low, high = curve.min(axis=0), curve.max(axis=0)
    curve = (2 * (curve - low) / (high - low) - 1) * (HALF_AREA - 0.3)
    return driven(hall, curve)


def driven(hall: SteelHall, curve: FloatArray) -> Path:
    """Return poses along a curve, (N, 2), that bends around structures, heading along it."""
    curve = hall.pushed(curve, BODY_M)
    ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    slope = hall.floor.slope(curve)
    cos, sin = np.cos(yaw), np.sin(yaw)
    pitch = -(cos * slope[:, 0] + sin * slope[:, 1])
    roll = -sin * slope[:, 0] + cos * slope[:, 1]
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    return Path(R, np.column_stack([curve, LIDAR_M + hall.floor.height(curve)]))


def _mounted(
    rng: np.random.Generator, span: tuple[float, float], count: int
) -> tuple[KnownSensor, ...]:
    """Return sensors within 0.3 m of the lidar sideways and within the span of heights."""
    low = np.array([-0.3, -0.3, span[0] - LIDAR_M])
    high = np.array([0.3, 0.3, span[1] - LIDAR_M])
    sensors = []
    for index in range(count):
        R = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
        C = (np.eye(3) + rng.normal(0, 0.04, (3, 3))) @ R
        distortion = Distortion(C, rng.normal(0, 15, 3))
        sensors.append(KnownSensor(f"mag_{index:02d}", rng.uniform(low, high), distortion))
    return tuple(sensors)


def _rows(hall: SteelHall, points: FloatArray, count: int) -> IntArray:
    """Return the rows of a path, spread evenly over those where the sensor is free."""
    free = np.flatnonzero(hall.free(points, CLEARANCE_M))
    return free[np.linspace(0, len(free) - 1, count).round().astype(np.int64)]


def _measured(hall: SteelHall, path: Path, sensor: KnownSensor, rows: IntArray) -> FloatArray:
    """Return what a sensor reads without noise, shape (N, 3) in uT."""
    B = hall.world.field(path.at(sensor.t_lidar_mag)[rows])
    return sensor.distortion.apply(np.einsum("nji,nj->ni", path.R[rows], B))
