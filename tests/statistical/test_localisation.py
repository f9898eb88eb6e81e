"""Whether the stated errors of localised poses are true, over many surveys and drives."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.progress import silent
from l2m_gtsam.records.localisation import LocalisationStatus
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.slam import calibrated, rounds, slam_drive
from tests.support.pose_errors import pose_nees, position_error
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.surveyed import NOISE, survey

DRIVES = 12


def one_drive(seed: int) -> FloatArray:
    """Return NEES of the poses, error before and after in metres."""
    rng = np.random.default_rng(seed)
    world, sensors = dipole_world(seed), random_sensors(seed, 2)
    drive = slam_drive(world, sensors, rounds(30), rng, NOISE)
    result = localise(
        drive.recording, survey(world, rng), calibrated(sensors, NOISE), SlamOptions(), silent
    ).result
    assert result.status is LocalisationStatus.LOCALISED
    nees = float(pose_nees(drive.truth, result.trajectory).mean())
    before, after = (
        position_error(drive.truth, each) for each in (result.odometry, result.trajectory)
    )
    print(
        f"drive {seed}: NEES {nees:.1f}, {1e3 * before:.0f} mm before, {1e3 * after:.0f} mm after"
    )
    return np.array([nees, before, after])


@pytest.mark.study
def test_stated_errors_of_poses_are_true() -> None:
    """A NEES of 6 is consistent. Poses of a drive err together, so that each drive counts as one.

    A drive's mean scatters by several; the mean of twelve stays within 3 and 12 if sigmas are true
    within a factor of 1.4.
    """
    figures = np.stack([one_drive(seed) for seed in range(DRIVES)])
    nees, _, after = figures.mean(axis=0)
    assert 3 < nees < 12
    assert after < 0.05
