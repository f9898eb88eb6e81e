"""A small survey of which a map knows its errors, and a drive of two sensors over it."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.maps.harmonic.error_modes import ErrorModes
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
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


def small_sensors(count: int, seed: int = 3) -> tuple[KnownSensor, ...]:
    """Sensors within 0.2 m of the lidar."""
    return tuple(
        KnownSensor(s.sensor, 0.3 * s.t_lidar_mag, s.distortion)
        for s in random_sensors(seed, count)
    )


SENSORS = small_sensors(2)
STARTS = np.stack([s.t_lidar_mag for s in SENSORS]) + 0.05


@cache
def surveyed(seed: int = 0, count: int = 700) -> HarmonicMap:
    """Return the map of a survey, in nine tiles and more."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.5, -1.5, 0.2], [1.5, 1.5, 0.8], (count, 3))
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, GIVEN.noise, points.shape)
    return HarmonicMap.fit(points, field, OPTIONS)


def turning_poses(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Poses ``R_map_lidar`` and ``p_map_lidar`` anywhere in the survey, tilted a little."""
    angles = np.column_stack([rng.uniform(-np.pi, np.pi, count), rng.normal(0, 0.15, (count, 2))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    return R, np.column_stack([rng.uniform(-1.1, 1.1, (count, 2)), rng.uniform(0.4, 0.6, count)])


def turning_drive(count: int = 150) -> Readings:
    """A drive over all of the survey, turning, tilting and heaving; readings of each sensor."""
    rng = np.random.default_rng(1)
    N = count * len(SENSORS)
    R, p = turning_poses(rng, N)
    sensor = np.repeat(np.arange(len(SENSORS)), count)
    t = np.stack([s.t_lidar_mag for s in SENSORS])[sensor]
    B, _ = WORLD.field_and_gradient(np.einsum("nij,nj->ni", R, t) + p)
    b = np.einsum("nji,nj->ni", R, B)
    measured = [s.distortion.apply(b[sensor == i]) for i, s in enumerate(SENSORS)]
    field = np.concatenate(measured) + rng.normal(0, NOISE, (N, 3))
    stamps = np.tile(np.arange(count) * 50_000_000, len(SENSORS))
    return Readings(tuple(s.sensor for s in SENSORS), sensor, stamps, R, p, field)


def dense_rows(
    readings: Readings, field_map: HarmonicMap, theta: FloatArray, A: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (N, 3) and their derivatives (N, 3, n) by all unknowns."""
    S, beta = len(SENSORS), theta[15 * len(SENSORS) :]
    parts = theta[: 15 * S].reshape(S, 15)[readings.sensor]
    t, C, H = parts[:, :3], parts[:, 3:12].reshape(-1, 3, 3), parts[:, 12:]
    R = readings.R_map_lidar
    B, G = field_map.field_and_gradient(np.einsum("nij,nj->ni", R, t) + readings.p_map_lidar)
    b = np.einsum("nji,nj->ni", R, B + A @ beta)
    e = np.einsum("nij,nj->ni", C, b) + H - readings.field
    CR = C @ R.transpose(0, 2, 1)
    J = np.zeros((len(readings), 3, len(theta)))
    for n, sensor in enumerate(readings.sensor):
        own = J[n, :, 15 * sensor : 15 * sensor + 15]
        own[:, :3] = CR[n] @ G[n] @ R[n]
        own[:, 3:12] = np.kron(np.eye(3), b[n])
        own[:, 12:] = np.eye(3)
    J[:, :, 15 * S :] = CR @ A
    return e, J


def all_features(errors: ErrorModes, points: FloatArray) -> FloatArray:
    """Return A over all beta, shape (N, 3, K)."""
    A = np.zeros((len(points), 3, len(errors.covariance)))
    owner, start = errors.owner(points), 0
    for tile, size in errors.sizes().items():
        rows = np.flatnonzero(owner == tile)
        A[rows, :, start : start + size] = errors.features(points[rows], tile)
        start += size
    return A


def own_noise(
    field_map: HarmonicMap, points: FloatArray, A: FloatArray, CR: FloatArray
) -> FloatArray:
    """Return the covariance of each reading's own errors, its noise and the map's, (N, 3, 3).

    ``A`` has what of the map's error the modes explain, ``CR`` turns fields into readings.
    """
    rest = np.maximum(field_map.variance(points) - np.einsum("nir,nir->ni", A, A), 0.0)
    return np.asarray(NOISE**2 * np.eye(3) + np.einsum("nij,nj,nkj->nik", CR, rest, CR))
