"""A vehicle on an even floor: its odometry errs in x, y and heading alone."""

from dataclasses import replace
from functools import cache

import numpy as np

from l2m_gtsam.progress import silent
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.drive import stacked
from l2m_gtsam.slam.options import DriftOptions, SlamOptions
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.studies.slam.methods import rms
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.slam import rounds
from tests.support.pose_errors import mean_nees
from tests.worlds.exact import dipole_world, random_sensors

SEEDS = range(6)
EXACT = np.full(15, 1e-6)
ALIKE = DriftOptions(position_share=0.03, rotation_deg_per_m=0.2, steady=0.0)
LEVEL = ALIKE.model_copy(update={"height_share": 0.0, "tilt_deg_per_m": 0.0})


@cache
def driven(seed: int) -> DrawnDrive:
    """Return a drive of 18 m with one sensor, whose odometry hardly errs in height and tilts."""
    truth = rounds(30)[np.arange(0, 600, 2)]
    rng = np.random.default_rng(seed)
    return drawn_drive(
        dipole_world(seed), random_sensors(seed, 1), truth, rng, EXACT, 2.0, 3, LEVEL
    )


@cache
def errors(seed: int, *, level: bool) -> tuple[float, float]:
    """Return rms error of the positions in metres, and mean NEES of the poses, that steps leave.

    They are stated as level as they are, or to err alike along all axes.
    """
    drawn = driven(seed)
    drive = drawn.drive
    if not level:
        steps = drive.steps
        covariance = drift_covariance(steps.R, steps.p, ALIKE)
        drive = replace(drive, steps=replace(steps, covariance=covariance))
    found = localise_drive(drive, dipole_world(seed), SlamOptions(drift=ALIKE), silent)
    off = rms(stacked(found.poses)[1], drawn.p)
    return off, mean_nees(found.poses, found.pose_covariance, drawn.poses)


def test_what_is_known_of_a_level_vehicle_makes_poses_better() -> None:
    """Of one sensor's three numbers per reading some say less of height and tilts, more of x, y."""
    ratio = [errors(seed, level=True)[0] / errors(seed, level=False)[0] for seed in SEEDS]
    assert np.mean(ratio) < 0.9


def test_poses_of_a_level_vehicle_are_as_sure_as_they_say() -> None:
    """Poses of a drive err together: no more than half as much again in the mean."""
    assert 3 < np.mean([errors(seed, level=True)[1] for seed in SEEDS]) < 9
