"""Localisation in a map by particles that weigh by the field's strength."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.slam.options import DriftOptions
from l2m_gtsam.studies.peers.particle_filters import MapParticlesOptions, map_particles
from l2m_gtsam.studies.slam.methods import rms, squared_errors
from l2m_gtsam.studies.slam_array.odometry import walked
from tests.drives.slam import laps
from tests.worlds.exact import dipole_world

T_LIDAR_MAG = np.array([[0.4, 0.0, 0.0], [-0.3, 0.2, 0.1]])
NOISE_UT = 0.5
OPTIONS = MapParticlesOptions(particles=400, noise_ut=NOISE_UT)


@pytest.fixture(scope="module")
def drive() -> tuple[Trajectory, Trajectory, FloatArray]:
    """A lap of 21 m, odometry that errs as it states, and the strength at two sensors."""
    truth = laps(35)[np.arange(0, 700, 4)]
    rng, world = np.random.default_rng(4), dipole_world(1)
    at = truth.p[:, None] + np.einsum("nij,sj->nsi", truth.R, T_LIDAR_MAG)
    field = world.field_and_gradient(at.reshape(-1, 3))[0]
    strength = np.linalg.norm(field, axis=1).reshape(len(truth), -1)
    return truth, walked(truth, rng), strength + NOISE_UT * rng.normal(size=strength.shape)


def found(odometry: Trajectory, strength: FloatArray, seed: int = 0) -> Trajectory:
    world = dipole_world(1)
    return map_particles(odometry, strength, T_LIDAR_MAG, world, DriftOptions(), OPTIONS, seed)


def test_the_map_holds_the_path(drive: tuple[Trajectory, Trajectory, FloatArray]) -> None:
    """Errors are less than odometry's, and within a factor of two of what is stated."""
    truth, odometry, strength = drive
    path = found(odometry, strength)
    assert rms(path.p, truth.p) < 2 / 3 * rms(odometry.p, truth.p)
    squared = squared_errors(path, truth)
    assert squared is not None
    assert squared.mean() < 12


def test_without_readings_the_particles_follow_odometry(
    drive: tuple[Trajectory, Trajectory, FloatArray],
) -> None:
    """Their mean is odometry's path, to the spread of 400, and their spread its drift."""
    _, odometry, strength = drive
    path = found(odometry, np.full_like(strength, np.nan))
    assert path.covariance is not None
    sigma = np.sqrt(np.trace(path.covariance[:, 3:, 3:], axis1=1, axis2=2))
    off = np.linalg.norm(path.p - odometry.p, axis=1)
    assert (off <= 5 * sigma / np.sqrt(OPTIONS.particles) + 1e-9).all()
    length = np.linalg.norm(np.diff(odometry.p, axis=0), axis=1).sum()
    level = DriftOptions().position_share * np.sqrt(DriftOptions().over_m * length)
    assert 0.5 * level < sigma[-1] < 4 * level


def test_a_seed_gives_the_same_path(drive: tuple[Trajectory, Trajectory, FloatArray]) -> None:
    _, odometry, strength = drive
    begin = odometry[np.arange(40)]
    first, again, other = (found(begin, strength[:40], seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.p, again.p)
    assert not np.array_equal(first.p, other.p)
