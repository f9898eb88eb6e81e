"""A small survey of which a map knows its errors, and a drive of two sensors over it."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import KnownSensor, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.search import SearchOptions
from tests.worlds.exact import DipoleWorld, dipole_world, random_sensors

NOISE = 0.1
GIVEN = Hyperparameters(
    floor_scale=6.0, floor_depth=0.7, ceiling_scale=2.0, ceiling_depth=1.4, noise=0.2
)
CALM = dipole_world(1)
WORLD = DipoleWorld(CALM.uniform, CALM.positions, 4 * CALM.moments)
OPTIONS = HarmonicOptions(
    hyperparameters=GIVEN, search=SearchOptions(rounds=0), modes=200, mode_share=0.5
)


def small_sensors(count: int) -> tuple[KnownSensor, ...]:
    """Sensors within 0.2 m of the lidar."""
    return tuple(
        KnownSensor(s.sensor, 0.3 * s.t_lidar_mag, s.distortion) for s in random_sensors(3, count)
    )


SENSORS = small_sensors(2)
STARTS = np.stack([s.t_lidar_mag for s in SENSORS]) + 0.05


def surveyed_map() -> HarmonicMap:
    """A survey of 700 readings in nine tiles and more."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -1.5, 0.2], [1.5, 1.5, 0.8], (700, 3))
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, GIVEN.noise, points.shape)
    return HarmonicMap.fit(points, field, OPTIONS)


def turning_drive(count: int = 150) -> Readings:
    """A drive over all of the survey, turning, tilting and heaving; readings of each sensor."""
    rng = np.random.default_rng(1)
    N = count * len(SENSORS)
    angles = np.column_stack([rng.uniform(-np.pi, np.pi, N), rng.normal(0, 0.15, (N, 2))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    p = np.column_stack([rng.uniform(-1.1, 1.1, (N, 2)), rng.uniform(0.4, 0.6, N)])
    sensor = np.repeat(np.arange(len(SENSORS)), count)
    t = np.stack([s.t_lidar_mag for s in SENSORS])[sensor]
    B, _ = WORLD.field_and_gradient(np.einsum("nij,nj->ni", R, t) + p)
    b = np.einsum("nji,nj->ni", R, B)
    measured = [s.distortion.apply(b[sensor == i]) for i, s in enumerate(SENSORS)]
    field = np.concatenate(measured) + rng.normal(0, NOISE, (N, 3))
    stamps = np.tile(np.arange(count) * 50_000_000, len(SENSORS))
    return Readings(tuple(s.sensor for s in SENSORS), sensor, stamps, R, p, field)
