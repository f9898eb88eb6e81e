"""A sensor that was moved after it was calibrated: localisation finds it and does without."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, KnownSensor
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import messages
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.online import driven
from tests.drives.slam import calibrated, rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

WORLD = dipole_world(1)
OPTIONS = SlamOptions.model_validate({"key_poses": {"readings": 2}, "calibration": "refined"})
SIGMA = np.concatenate([np.full(3, 0.002), np.full(9, 0.002), np.full(3, 0.1)])


def knocked(sensor: KnownSensor) -> KnownSensor:
    """Return a sensor 3 cm further and turned by 5 degrees."""
    turn = Rotation.from_rotvec(np.deg2rad([0.0, 3.0, 4.0])).as_matrix()
    place = sensor.t_lidar_mag + np.array([0.03, 0.0, 0.0])
    return KnownSensor(
        sensor.sensor, place, Distortion(turn @ sensor.distortion.C, sensor.distortion.H)
    )


def test_it_is_left_out_and_poses_are_those_of_the_others() -> None:
    first, second, third = sensors = random_sensors(21, 3)
    known = calibrated(sensors, sigma=SIGMA, rng=np.random.default_rng(2))
    moved = (first, knocked(second), third)
    drive = slam_drive(WORLD, moved, rounds(12), np.random.default_rng(21))
    found = localise(drive.recording, WORLD, known, OPTIONS, silent).result
    assert [each.sensor for each in found.sensors] == [first.sensor, third.sensor]
    assert f"{second.sensor} is left out: with it poses would contradict" in found.notes[-1]
    series = tuple(each for each in drive.recording.series if each.sensor != second.sensor)
    rest = replace(drive.recording, series=series)
    expected = localise(rest, WORLD, known, OPTIONS, silent).result
    np.testing.assert_array_equal(found.trajectory.p, expected.trajectory.p)
    assert found.calibration is not None
    # What is not refined stays in the calibration as it was.
    assert found.calibration[second.sensor].message == known[second.sensor].message


def test_on_line_it_is_reported_first() -> None:
    first, second, third = sensors = random_sensors(21, 3)
    known = calibrated(sensors, sigma=SIGMA, rng=np.random.default_rng(2))
    moved = (first, knocked(second), third)
    drive = slam_drive(WORLD, moved, rounds(12), np.random.default_rng(21))
    run = driven(OnlineSlam(known, OPTIONS, WORLD), messages(drive.recording))
    told = run.texts(EventKind.CALIBRATION_REFUTED)
    assert f"{second.sensor} contradicts its calibration" in told[0]
    assert len(told) <= 3


def test_sensors_that_hold_all_count() -> None:
    sensors = random_sensors(21, 3)
    known = calibrated(sensors, sigma=SIGMA, rng=np.random.default_rng(2))
    drive = slam_drive(WORLD, sensors, rounds(12), np.random.default_rng(21))
    found = localise(drive.recording, WORLD, known, OPTIONS, silent).result
    assert len(found.sensors) == 3
    assert not any("left out" in each for each in found.notes)
    run = driven(OnlineSlam(known, OPTIONS, WORLD), messages(drive.recording))
    assert EventKind.CALIBRATION_REFUTED not in run.kinds
