"""A sensor that was moved after it was calibrated: localisation finds it and does without."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, KnownSensor
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.moved_sensors import without_series
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import give, messages
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
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


def test_on_line_it_is_left_out_once_the_way_shows_it() -> None:
    """From then on poses are those of the others, of which a resumed drive knows, too."""
    first, second, third = sensors = random_sensors(21, 3)
    known = calibrated(sensors, sigma=SIGMA, rng=np.random.default_rng(2))
    moved = (first, knocked(second), third)
    drive = slam_drive(WORLD, moved, rounds(12), np.random.default_rng(21))
    given = list(messages(drive.recording))
    slam = OnlineSlam(known, OPTIONS, WORLD)
    run = driven(slam, given)
    told = run.texts(EventKind.CALIBRATION_REFUTED)
    assert f"{second.sensor} is left out: with it poses would contradict" in told[-1]
    assert len(told) <= 3
    at_ns = next(e.stamp_ns for e in run.events if "is left out" in e.text)
    rest = without_series(drive.recording, [second.sensor])
    expected = driven(OnlineSlam(known, OPTIONS, WORLD), messages(rest)).trajectory()
    found = run.trajectory()
    late = found.stamp_ns > at_ns
    assert late.mean() > 0.3
    np.testing.assert_allclose(found.p[late], expected.p[late], atol=1e-6)
    # Both have left the same: a state of it goes on without the sensor.
    half = len(given) * 3 // 4
    slam = OnlineSlam(known, OPTIONS, WORLD)
    for each in given[:half]:
        give(slam, each)
    slam.events()
    again = driven(resumed_slam(saved_state(slam), known, OPTIONS, WORLD), given[half:])
    assert again.kinds == [EventKind.RESUMED]
    on = again.trajectory()
    assert on.covariance is not None
    sigma = np.sqrt(np.einsum("kii->ki", on.covariance[:, 3:, 3:]))
    off = on.p - found.p[np.isin(found.stamp_ns, on.stamp_ns)]
    # Saving ends a section of the smoother, which moves poses by a fraction of their sigmas.
    assert (np.abs(off) / sigma).max() < 0.3


def test_sensors_that_hold_all_count() -> None:
    sensors = random_sensors(21, 3)
    known = calibrated(sensors, sigma=SIGMA, rng=np.random.default_rng(2))
    drive = slam_drive(WORLD, sensors, rounds(12), np.random.default_rng(21))
    found = localise(drive.recording, WORLD, known, OPTIONS, silent).result
    assert len(found.sensors) == 3
    assert not any("left out" in each for each in found.notes)
    run = driven(OnlineSlam(known, OPTIONS, WORLD), messages(drive.recording))
    assert EventKind.CALIBRATION_REFUTED not in run.kinds
