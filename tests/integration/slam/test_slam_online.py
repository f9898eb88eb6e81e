"""Calibrations found on line, from values that are far off."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.progress import silent
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.smoother import localise_drive
from tests.drives.following import followed_beliefs
from tests.drives.slam import COARSE, calibrated, small_hall
from tests.worlds.exact import dipole_world

LATE = 8  # key poses
FAR = np.concatenate([np.full(3, 0.1), np.full(9, 0.1), np.full(3, 20.0)])


def test_a_calibration_that_is_far_off_converges_on_line() -> None:
    """C off by 0.1, H by 20 uT, t by 10 cm: on line it ends where all poses solved together do."""
    sensors, recorded = small_hall(21, seconds=25)
    rough = calibrated(sensors, sigma=FAR, rng=np.random.default_rng(8))
    options = SlamOptions(calibration=CalibrationUse.REFINED, key_poses=COARSE)
    drive, _ = prepared(recorded.recording, rough, options)
    world = dipole_world(1)
    last = followed_beliefs(drive, world, options.robust, free=True, section=50)[-1]
    batch = localise_drive(drive, world, options, silent)
    sigma = np.sqrt(np.einsum("sii->si", batch.calibration_covariance))
    apart = np.abs(last.sensors.vectors() - batch.drive.sensors.vectors()) / sigma
    assert apart.max() < 1.0
    ideal = np.stack([each.vector() for each in sensors])
    wrong = [np.abs(each.vectors() - ideal) for each in (drive.sensors, last.sensors)]
    # Each of the three kinds of numbers comes nearer to the truth, by far more than by chance.
    for columns in (slice(0, 3), slice(3, 12), slice(12, 15)):
        before, after = (np.sqrt(np.mean(each[:, columns] ** 2)) for each in wrong)
        assert after < 0.4 * before


@pytest.mark.parametrize("heard", ["one", "none"])
def test_sensors_may_be_heard_late(heard: str) -> None:
    """What nothing was read of yet is known as at the start, and is found from then on."""
    sensors, recorded = small_hall(21, seconds=25)
    rough = calibrated(sensors, sigma=0.1 * FAR, rng=np.random.default_rng(8))
    options = SlamOptions(calibration=CalibrationUse.REFINED, key_poses=COARSE)
    drive, _ = prepared(recorded.recording, rough, options)
    late, readings = {"one": [1], "none": range(len(sensors))}[heard], drive.readings
    silent = np.isin(readings.sensor, late) & (readings.key_pose < LATE)
    drive = replace(drive, readings=readings[np.flatnonzero(~silent)])
    found = followed_beliefs(drive, dipole_world(1), options.robust, free=True, section=50)
    known = [each.sensors for each in found]
    np.testing.assert_allclose(known[LATE - 1].vectors()[1], drive.sensors.vectors()[1], atol=1e-9)
    ideal = np.stack([each.vector() for each in sensors])
    before, after = (np.abs(each.vectors() - ideal)[1, 12:] for each in (drive.sensors, known[-1]))
    assert np.linalg.norm(after) < 0.5 * np.linalg.norm(before)
