"""Drives whose place in a map is not known."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import KnownSensor
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.slam import SlamDrive, slam_drive
from tests.worlds.exact import DipoleWorld, random_sensors
from tests.worlds.surveyed import in_odometry, wandering

QUICK = {"readings": 40, "seeds": 60, "step_m": 0.25}  # small rooms, strong fields


def searching(**search: object) -> SlamOptions:
    return SlamOptions.model_validate({"start": {"anywhere": True, "search": QUICK | search}})


def lost_drive(
    world: DipoleWorld, seed: int, seconds: float = 20.0, sensors: int = 2
) -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    """Return a drive whose odometry is in a frame of its own."""
    rng, known = np.random.default_rng(seed), random_sensors(seed, sensors)
    drive = slam_drive(world, known, wandering(rng, seconds), rng)
    return known, replace(drive, recording=in_odometry(drive.recording, rng))
