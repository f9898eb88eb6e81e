"""Drives whose sensors' places are searched for without an initial guess."""

import numpy as np

from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.data import Readings, Trajectory
from tests.worlds.exact import DipoleWorld, dipole_world, drive, random_sensors, read_together

# The exact field of these worlds is slow to compute: fewer poses, fewer dipoles.
OPTIONS = StartOptions(poses=60)
# What sixty noisy readings know of the place, in metres; from there the solve goes on with all.
NEAR = 0.1
SENSORS = random_sensors(4, 3)
WORLD = dipole_world(4, count=12)


def together(seed: int = 4, noise: float = 0.2, world: DipoleWorld = WORLD) -> Readings:
    """Return what three sensors of one vehicle read, each at poses that all of them share."""
    one = drive(seed, SENSORS[:1], world, count=400)
    poses = Trajectory(one.stamp_ns, one.R_map_lidar, one.p_map_lidar, "map", "lidar")
    return read_together(SENSORS, world, poses, np.random.default_rng(seed), noise)


PERIOD = 2.0  # metres


def corridor() -> DipoleWorld:
    """Return a field that comes again every two metres of the drive's only direction."""
    rng = np.random.default_rng(3)
    cell = rng.uniform([0, -0.8, -0.8], [PERIOD, 0.8, -0.4], (5, 3))
    moments = rng.normal(0, 10, (5, 3))
    shifts = PERIOD * np.arange(-3, 10)[:, None, None] * np.array([1.0, 0.0, 0.0])
    positions = (cell + shifts).reshape(-1, 3)
    return DipoleWorld(np.array([20.0, 0.0, -40.0]), positions, np.tile(moments, (13, 1)))
