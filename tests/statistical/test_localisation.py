"""Whether the stated errors of localised poses are true, over many surveys and drives."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.records.localisation import LocalisationStatus
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.slam import calibrated, rounds, slam_drive
from tests.integration.slam.test_slam import pose_nees, position_error, quiet
from tests.worlds.exact import DipoleWorld, dipole_world, random_sensors
from tests.worlds.quick_maps import quick

DRIVES = 12
NOISE = 0.2  # uT


def survey(world: DipoleWorld, rng: np.random.Generator) -> FieldMap:
    """Return a map from readings at three heights over the middle of the hall."""
    lines = np.arange(-4.4, 4.5, 0.3)
    x, y = (axis.ravel() for axis in np.meshgrid(lines, lines))
    points = np.column_stack([x, y, rng.choice([0.2, 0.5, 0.9], len(x))])
    points += rng.normal(0, 0.03, points.shape)
    field, _ = world.field_and_gradient(points)
    return build_map(points, field + NOISE * rng.normal(size=field.shape), quick("harmonic"))


def one_drive(seed: int) -> FloatArray:
    """Return NEES of the poses, error before and after in metres."""
    rng = np.random.default_rng(seed)
    world, sensors = dipole_world(seed), random_sensors(seed, 2)
    drive = slam_drive(world, sensors, rounds(30), rng, NOISE)
    result = localise(
        drive.recording, survey(world, rng), calibrated(sensors, NOISE), SlamOptions(), quiet
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
    """NEES of 6 is honest. Poses of a drive err together, so that each drive counts as one.

    A drive's mean scatters by several; the mean of twelve stays within 3 and 12 if sigmas are true
    within a factor of 1.4.
    """
    figures = np.stack([one_drive(seed) for seed in range(DRIVES)])
    nees, _, after = figures.mean(axis=0)
    assert 3 < nees < 12
    assert after < 0.05
