"""What goes wrong on a drive beside spikes: bursts, steel that was moved since the survey."""

import numpy as np

from l2m_gtsam.data import BoolArray
from l2m_gtsam.simulate.hall_drives import CalibrationDrive
from l2m_gtsam.studies.honesty.drives import SHARE, Disturbed, disturbed

MOMENT = 4.0  # A m^2, of a steel part: felt beyond thrice the noise along 5 m of the drive
ASIDE_M = 0.9


def bursts(drive: CalibrationDrive, seed: int) -> Disturbed:
    """Three times for a while a motor adds 40 uT to all sensors, a tenth of the time together."""
    rng, stamps = np.random.default_rng([seed, 2]), drive.readings.stamp_ns
    span = stamps.max() - stamps.min()
    starts = stamps.min() + rng.uniform(0, 1 - SHARE, 3) * span
    on: BoolArray = np.zeros(len(stamps), dtype=np.bool_)
    for start in starts:
        on |= (stamps >= start) & (stamps < start + SHARE / 3 * span)
    direction = rng.standard_normal(3)
    strength = 40 * (1 + 0.3 * rng.standard_normal(len(stamps))) / np.linalg.norm(direction)
    return disturbed(drive, (on * strength)[:, None] * direction)


def moved_steel(drive: CalibrationDrive, seed: int) -> Disturbed:
    """A steel part stands beside the path that was not there when the place was surveyed."""
    rng, readings = np.random.default_rng([seed, 3]), drive.readings
    own = readings.rows_of(0)
    k = rng.integers(100, len(readings.p_map_lidar[own]) - 100)
    aside = ASIDE_M * rng.choice([-1, 1]) * readings.R_map_lidar[own][k][:, 1]
    where = readings.p_map_lidar[own][k] + aside - [0, 0, 0.3]
    moment = rng.standard_normal(3)
    moment *= MOMENT / np.linalg.norm(moment)
    t = np.stack([sensor.t_lidar_mag for sensor in drive.sensors])[readings.sensor]
    C = np.stack([sensor.distortion.C for sensor in drive.sensors])[readings.sensor]
    r = np.einsum("nij,nj->ni", readings.R_map_lidar, t) + readings.p_map_lidar - where
    away = np.linalg.norm(r, axis=1)[:, None]
    B = 0.1 * (3 * r * (r @ moment)[:, None] / away**5 - moment / away**3)  # mu_0 / 4 pi, uT
    change = np.einsum("nij,nkj,nk->ni", C, readings.R_map_lidar.transpose(0, 2, 1), B)
    return disturbed(drive, change)
