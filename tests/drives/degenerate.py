"""Drives that leave something open, and fields that do, with what is open known by construction."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import (
    Distortion,
    FieldSample,
    FieldSeries,
    FloatArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from tests.worlds.exact import DipoleWorld, dipole_world, exact_reading

NOISE = 0.2
COUNT = 300
STEP_NS = 50_000_000
STRONG = dipole_world(11, 15)
CALM = DipoleWorld(STRONG.uniform, STRONG.positions, 0.03 * STRONG.moments)
UNIFORM = DipoleWorld(STRONG.uniform, STRONG.positions, 0.0 * STRONG.moments)


@dataclass(frozen=True)
class ColumnWorld:
    """A field that is the same at all heights: upright posts without end, beside the drive.

    Attributes
    ----------
    uniform
        Field without posts in uT, shape (3,).
    positions, moments
        Posts, metres and uT m^2, shape (K, 2).
    """

    uniform: FloatArray
    positions: FloatArray
    moments: FloatArray

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m.

        With z = x + i y and m likewise a line of dipoles has B_x - i B_y = m / z^2.
        """
        r, m = (part @ [1.0, 1.0j] for part in (points[:, None, :2] - self.positions, self.moments))
        B, slope = np.sum(m / r**2, axis=1), np.sum(-2 * m / r**3, axis=1)
        field, gradient = np.tile(self.uniform, (len(points), 1)), np.zeros((len(points), 3, 3))
        field[:, :2] += np.column_stack([B.real, -B.imag])
        gradient[:, 0, 0], gradient[:, 0, 1] = slope.real, -slope.imag
        gradient[:, 1, 0], gradient[:, 1, 1] = -slope.imag, -slope.real
        return field, gradient

    def query(self, points: FloatArray) -> FieldSample:
        """Return the exact field: no variance, inside everywhere."""
        field, gradient = self.field_and_gradient(points)
        inside = np.ones(len(points), dtype=np.bool_)
        return FieldSample(field, gradient, np.zeros_like(field), inside)


World = DipoleWorld | ColumnWorld
POSTS = ColumnWorld(
    STRONG.uniform,
    np.array([[4.5, 1.0], [-4.5, -2.0], [0.5, 4.0], [-1.0, -4.5], [5.0, -4.0]]),
    np.random.default_rng(4).normal(0, 20, (5, 2)),
)

PLACES = np.array([[0.2, -0.1, 0.15]])


def poses(yaw: FloatArray, p: FloatArray, pitch: float = 0.0, roll: float = 0.0) -> Trajectory:
    """Return a drive; ``pitch`` and ``roll`` are amplitudes in radians."""
    s = np.linspace(0, 1, len(p))
    angles = np.column_stack([yaw, pitch * np.sin(33 * s), roll * np.cos(50 * s)])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    stamps = 1_700_000_000_000_000_000 + np.arange(len(p)) * STEP_NS
    return Trajectory(stamps, R, p, "map", "lidar")


def at_height(x: FloatArray, y: FloatArray, heave: float = 0.0) -> FloatArray:
    """Return positions half a metre over the floor, shape (N, 3)."""
    return np.column_stack([x, y, 0.5 + heave * np.sin(27 * np.linspace(0, 1, len(x)))])


def parked(jitter_m: float = 0.0, jitter_deg: float = 0.0) -> Trajectory:
    """A vehicle that stands still; poses of a real lidar are never quite the same."""
    rng = np.random.default_rng(0)
    yaw = np.deg2rad(jitter_deg) * rng.uniform(-1, 1, COUNT)
    return poses(yaw, rng.uniform(-1, 1, (COUNT, 3)) * jitter_m + [0.3, 0.2, 0.5])


def straight() -> Trajectory:
    """Six metres with one heading."""
    s = np.linspace(-3, 3, COUNT)
    return poses(np.full(COUNT, 0.3), at_height(s * np.cos(0.3), s * np.sin(0.3)))


def circle() -> Trajectory:
    """Two metres across, at one speed, heading along it."""
    s = np.linspace(0, 2 * np.pi, COUNT)
    return poses(s + np.pi / 2, at_height(np.cos(s), np.sin(s)))


def eight(tilt: float = 0.15, heave: float = 0.1) -> Trajectory:
    """A figure of eight through all headings."""
    s = np.linspace(0, 1, COUNT)
    p = at_height(3 * np.sin(6 * s), 2 * np.sin(12 * s), heave)
    return poses(9 * s, p, tilt, tilt)


def recorded(trajectory: Trajectory, world: World, places: FloatArray = PLACES) -> Recording:
    """Return what sensors at places, shape (S, 3), read on a drive, with noise."""
    rng = np.random.default_rng(7)
    series = []
    for sensor in mounted(places):
        read = exact_reading(world, sensor, trajectory.R, trajectory.p)
        field = read + rng.normal(0, NOISE, read.shape)
        series.append(FieldSeries(sensor.sensor, "/m", "m", trajectory.stamp_ns, field))
    return Recording(trajectory, tuple(series), SourceFile("drive.bag", "ab12"))


def mounted(places: FloatArray = PLACES) -> tuple[KnownSensor, ...]:
    """Return sensors at places, shape (S, 3), with a little distortion each."""
    rng = np.random.default_rng(5)
    sensors = []
    for index, place in enumerate(places):
        C = np.eye(3) + rng.normal(0, 0.04, (3, 3))
        sensors.append(KnownSensor(f"mag_{index}", place, Distortion(C, rng.normal(0, 10, 3))))
    return tuple(sensors)
