"""Fields with closed forms and random drives through them, for tests that need an exact map."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FieldSample, FloatArray, KnownSensor, Readings, Trajectory

DIPOLE_CONSTANT = 0.1  # mu_0 / 4 pi in uT m / A: B of a dipole of 1 A m^2 at 1 m is 0.1-0.2 uT


class Field(Protocol):
    """A field that is known everywhere."""

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]: ...


@njit(cache=True)
def add_dipoles(
    points: FloatArray, sources: FloatArray, field: FloatArray, gradient: FloatArray
) -> None:
    """Add field and gradient of dipoles, rows of place and moment: sums of numpy are slow here."""
    r, m = np.empty(3), np.empty(3)
    for n in range(len(points)):
        for k in range(len(sources)):
            squared = along = 0.0
            for i in range(3):
                r[i], m[i] = points[n, i] - sources[k, i], sources[k, 3 + i]
                squared += r[i] * r[i]
                along += m[i] * r[i]
            d3 = DIPOLE_CONSTANT / (squared * np.sqrt(squared))
            d5 = d3 / squared
            d7 = 15 * along * d5 / squared
            for i in range(3):
                field[n, i] += 3 * along * d5 * r[i] - d3 * m[i]
                gradient[n, i, i] += 3 * along * d5
                for j in range(3):
                    mixed = 3 * d5 * (m[i] * r[j] + r[i] * m[j])
                    gradient[n, i, j] += mixed - d7 * r[i] * r[j]


@dataclass(frozen=True)
class DipoleWorld:
    """Point dipoles in a uniform field: exact values and gradients everywhere.

    Attributes
    ----------
    uniform
        Field without dipoles in uT, shape (3,).
    positions, moments
        Dipoles, metres and A m^2, shape (K, 3).
    """

    uniform: FloatArray
    positions: FloatArray
    moments: FloatArray

    def with_dipoles(self, positions: FloatArray, moments: FloatArray) -> "DipoleWorld":
        """Return a world with more dipoles, metres and A m^2, shapes (N, 3) or (3,)."""
        return replace(
            self,
            positions=np.vstack([self.positions, positions]),
            moments=np.vstack([self.moments, moments]),
        )

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        at = np.ascontiguousarray(points, dtype=float)
        moments = np.broadcast_to(np.asarray(self.moments, dtype=float), self.positions.shape)
        sources = np.ascontiguousarray(np.hstack([self.positions, moments]))
        field, gradient = np.zeros((len(at), 3)), np.zeros((len(at), 3, 3))
        add_dipoles(at, sources, field, gradient)
        return self.uniform + field, gradient

    def query(self, points: FloatArray) -> FieldSample:
        """Return the exact field: no variance, inside everywhere."""
        field, gradient = self.field_and_gradient(points)
        return FieldSample(
            field, gradient, np.zeros_like(field), np.ones(len(points), dtype=np.bool_)
        )


class BoundedWorld(DipoleWorld):
    """A map that knows nothing east of x = 2 m, and says so as maps of files do."""

    def query(self, points: FloatArray) -> FieldSample:
        sample = super().query(points)
        inside = points[:, 0] < 2.0
        hidden = ~inside
        field, gradient, variance = sample.field, sample.gradient, sample.variance
        field[hidden], gradient[hidden], variance[hidden] = np.nan, np.nan, np.inf
        return FieldSample(field, gradient, variance, inside)


def dipole_world(seed: int, count: int = 40) -> DipoleWorld:
    """Return dipoles under and over the floor of a 12 x 12 m hall."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-6, -6, 0], [6, 6, 1], (count, 3))
    positions[:, 2] = np.where(rng.random(count) < 0.5, -0.6, 2.5)
    return DipoleWorld(np.array([22.0, 3.0, -38.0]), positions, rng.normal(0, 25, (count, 3)))


def random_sensors(seed: int, count: int) -> tuple[KnownSensor, ...]:
    """Return magnetometers within 0.6 m of the lidar with moderate random distortion."""
    rng = np.random.default_rng(seed)
    sensors = []
    for index in range(count):
        R = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
        C = (np.eye(3) + rng.normal(0, 0.04, (3, 3))) @ R
        t = rng.uniform(-0.6, 0.6, 3)
        sensors.append(KnownSensor(f"mag_{index:02d}", t, Distortion(C, rng.normal(0, 15, 3))))
    return tuple(sensors)


def exact_reading(world: Field, sensor: KnownSensor, R: FloatArray, p: FloatArray) -> FloatArray:
    """Return what a sensor reads at poses of the lidar, uT, shape (N, 3)."""
    B, _ = world.field_and_gradient(R @ sensor.t_lidar_mag + p)
    return sensor.distortion.apply(np.einsum("nji,nj->ni", R, B))


def read_together(
    sensors: tuple[KnownSensor, ...],
    world: Field,
    at: Trajectory,
    rng: np.random.Generator,
    noise: float,
) -> Readings:
    """Return what sensors of one vehicle read with noise, at poses that all of them share."""
    exact = [exact_reading(world, sensor, at.R, at.p) for sensor in sensors]
    n, count = len(sensors), len(at)
    return Readings(
        tuple(sensor.sensor for sensor in sensors),
        np.repeat(np.arange(n), count),
        np.tile(at.stamp_ns, n),
        np.tile(at.R, (n, 1, 1)),
        np.tile(at.p, (n, 1)),
        np.concatenate([each + rng.normal(0, noise, each.shape) for each in exact]),
    )


def drive(
    seed: int,
    sensors: tuple[KnownSensor, ...],
    world: DipoleWorld,
    count: int = 200,
    tilt: float = 0.15,
    noise: float = 0.0,
) -> Readings:
    """Return readings of a drive that turns in all headings, tilts and heaves.

    ``tilt`` is the standard deviation of roll and pitch in radians and, times a metre, of height;
    ``noise`` is the standard deviation of the sensors in uT.
    """
    rng = np.random.default_rng(seed)
    N = count * len(sensors)
    angles = np.column_stack([rng.uniform(-np.pi, np.pi, N), rng.normal(0, tilt, (N, 2))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    p = np.column_stack([rng.uniform(-4, 4, (N, 2)), 0.5 + rng.normal(0, tilt, N)])
    sensor = np.repeat(np.arange(len(sensors)), count)
    t = np.stack([s.t_lidar_mag for s in sensors])[sensor]
    B, _ = world.field_and_gradient(np.einsum("nij,nj->ni", R, t) + p)
    b = np.einsum("nji,nj->ni", R, B)
    field = np.concatenate(
        [s.distortion.apply(b[sensor == i]) for i, s in enumerate(sensors)]
    ) + noise * rng.normal(size=(N, 3))
    stamps = np.tile(np.arange(count) * 50_000_000, len(sensors))
    return Readings(tuple(s.sensor for s in sensors), sensor, stamps, R, p, field)
