"""Surveys, held-out places and calibration drives on the free floor of a steel hall."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import (
    BoolArray,
    Distortion,
    FieldSeries,
    FloatArray,
    KnownSensor,
    Readings,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.maps.training import TrainingSet, checked_readings
from l2m_gtsam.simulate.steel_hall import HALF_AREA, SteelHall

CLEARANCE_M = 0.4  # of every reading to posts and racks, horizontally
BODY_M = 0.55  # of the vehicle's middle
LANE_M = 0.4  # from lane to lane of a survey
LIDAR_M = 0.7  # height of the lidar over the floor
STEP_NS = 50_000_000


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

    @classmethod
    def along(
        cls,
        poses: Trajectory,
        sensors: tuple[KnownSensor, ...],
        free: Callable[[FloatArray], BoolArray],
        field: Callable[[FloatArray], FloatArray],
        noise: float,
        count: int,
        rng: np.random.Generator,
    ) -> "CalibrationDrive":
        """Return what sensors read on a path.

        Parameters
        ----------
        poses
            Of the lidar in the map.
        sensors
            With their true distortions.
        free, field
            Which places of the map, shape (N, 3) in metres, a sensor can be at, and the field there
            in uT, shape (N, 3).
        noise
            Standard deviation of a reading per axis in uT.
        count
            Readings of each sensor, at poses spread evenly over those where it is free.
        rng
            Of the noise.
        """
        rows, fields = [], []
        for sensor in sensors:
            places = poses.R @ sensor.t_lidar_mag + poses.p
            usable = np.flatnonzero(free(places))
            row = usable[np.linspace(0, len(usable) - 1, count).round().astype(np.int64)]
            b = np.einsum("nji,nj->ni", poses.R[row], field(places[row]))
            rows.append(row)
            fields.append(sensor.distortion.apply(b) + noise * rng.standard_normal(b.shape))
        row = np.concatenate(rows)
        readings = Readings(
            tuple(each.sensor for each in sensors),
            np.repeat(np.arange(len(sensors)), count),
            poses.stamp_ns[row],
            poses.R[row],
            poses.p[row],
            np.concatenate(fields),
        )
        return cls(readings, sensors, poses, np.zeros(len(sensors)))

    def recording(self, source: SourceFile) -> Recording:
        """Return the drive as it is recorded, each sensor on a topic and in a frame of its name."""
        read = self.readings
        series = tuple(
            FieldSeries(name, f"/{name}", name, read.stamp_ns[own], read.field[own])
            for index, name in enumerate(read.sensors)
            for own in [read.rows_of(index)]
        )
        return Recording(self.trajectory, series, source)

    def truth(self) -> FloatArray:
        """Return t, C row by row, H and time offset of every sensor, shape (S, 16)."""
        return np.column_stack([np.stack([s.vector() for s in self.sensors]), self.offset])


def survey(
    hall: SteelHall,
    seed: int,
    heights: tuple[float, ...] = (0.4, 0.7, 1.0),
    noise: float = 0.2,
    count: int = 1500,
) -> TrainingSet:
    """Return what a sensor reads in lanes over the whole area, along x and along y by turns.

    Lanes bend around structures. The sensor follows the uneven floor. Slightly
    fewer than ``count`` readings come about where two structures leave no room.
    """
    rng = np.random.default_rng([seed, 3])
    each = -(-count // len(heights))
    passes = [_pass(hall, rng, height, index % 2, each) for index, height in enumerate(heights)]
    points = np.concatenate(passes)
    points = points[hall.free(points, CLEARANCE_M)]
    field = hall.world.field(points) + noise * rng.standard_normal(points.shape)
    return checked_readings(points, field)


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
    poses, mounted = _path(hall, rng, 8 * count), _mounted(rng, span, sensors)
    free = partial(hall.free, clearance=CLEARANCE_M)
    return CalibrationDrive.along(poses, mounted, free, hall.world.field, noise, count, rng)


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


def _path(hall: SteelHall, rng: np.random.Generator, count: int) -> Trajectory:
    """Return a closed curve of a few loops over the floor, the vehicle heading along it."""
    order = np.arange(1, 7)
    s = 2 * np.pi * np.arange(count) / count
    weight = rng.standard_normal((2, len(order))) / np.sqrt(order)
    xy = np.sin(s[:, None, None] * order + rng.uniform(-np.pi, np.pi, (2, len(order)))) * weight
    curve = xy.sum(axis=2)
    low, high = curve.min(axis=0), curve.max(axis=0)
    curve = (2 * (curve - low) / (high - low) - 1) * (HALF_AREA - 0.3)
    return driven(hall, curve)


def driven(hall: SteelHall, curve: FloatArray) -> Trajectory:
    """Return poses along a curve, (N, 2), that bends around structures, heading along it."""
    curve = hall.pushed(curve, BODY_M)
    ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    slope = hall.floor.slope(curve)
    cos, sin = np.cos(yaw), np.sin(yaw)
    pitch = -(cos * slope[:, 0] + sin * slope[:, 1])
    roll = -sin * slope[:, 0] + cos * slope[:, 1]
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    p = np.column_stack([curve, LIDAR_M + hall.floor.height(curve)])
    return Trajectory(STEP_NS * np.arange(len(p)), R, p, "map", "lidar")


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
