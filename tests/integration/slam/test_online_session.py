"""Drives localised message by message, and what goes wrong on them."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.online.branches import BranchedFollower
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, key_poses_of
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.online.replay import FieldReading, give, messages
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from tests.drives.lost import lost_drive, searching
from tests.drives.online import (
    OPTIONS,
    Hall,
    OnlineRun,
    driven,
    in_map,
    seconds_of,
    with_readings,
)
from tests.drives.slam import COARSE, calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.surveyed import strange_hall, surveyed


def test_a_drive_is_localised_as_it_comes(hall: Hall, plain: OnlineRun) -> None:
    truth = hall[1].truth
    assert np.sqrt(np.mean(plain.off(truth) ** 2)) < 0.06  # the start is known within 0.1 m
    # Poses of one drive err together: no more than twice the six of one pose in the mean.
    assert plain.nees(truth)[1:].mean() < 12
    assert plain.events == ()
    assert plain.trajectory().stamp_ns[-1] == truth.stamp_ns[-1]


def test_key_poses_are_those_of_the_recording(
    hall: Hall,
) -> None:
    """What comes message by message is made into the same key poses as the drive off line."""
    recording, slam = hall[1].recording, in_map(hall)
    drive, _ = prepared(recording, calibrated(hall[0]), OPTIONS)
    found = list[ArrivedKeyPose]()
    for message in messages(recording):
        if isinstance(message, OdometryPose):
            slam.intake.add_odometry(message)
            found += slam.intake.key_poses()
        else:
            slam.add_reading(message.stamp_ns, message.sensor, message.field)
    found += slam.intake.key_poses(to_the_end=True)
    share = OPTIONS.drift.position_share
    for one, other in zip(found, key_poses_of(drive), strict=True):
        # The drift that is the same all along is followed by itself.
        assert (one.steady == (share if one.number else 0.0)).all()
        assert (one.number, one.stamp_ns) == (other.number, other.stamp_ns)
        np.testing.assert_array_equal(one.reading_ns, other.reading_ns)
        for name in ("R", "p", "covariance"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12)
        for name in ("sensor", "key_pose", "R_key_lidar", "p_key_lidar", "fraction", "field"):
            mine, theirs = (getattr(each.readings, name) for each in (one, other))
            np.testing.assert_allclose(mine, theirs, atol=1e-9)


def test_a_sensor_that_dies_and_returns_is_reported_and_does_no_harm(
    hall: Hall,
) -> None:
    """One sends nothing from 8 to 14 s, the other repeats a value from 16 to 20 s."""
    sensors, drive = hall
    held: list[FloatArray] = []

    def failing(reading: FieldReading) -> FieldReading | None:
        at = seconds_of(drive.recording, reading.stamp_ns)
        if reading.sensor == sensors[0].sensor:
            return None if 8 < at < 14 else reading
        if 16 < at < 20:
            held.append(reading.field)
            return replace(reading, field=held[0])
        return reading

    run = driven(in_map(hall), with_readings(messages(drive.recording), failing))
    kinds = [EventKind.SENSOR_SILENT, EventKind.SENSOR_BACK]
    assert run.kinds == [*kinds, EventKind.SENSOR_STUCK, EventKind.SENSOR_BACK]
    assert sensors[0].sensor in run.events[0].text
    assert sensors[1].sensor in run.events[2].text
    assert np.sqrt(np.mean(run.off(drive.truth) ** 2)) < 0.05
    assert run.nees(drive.truth)[1:].mean() < 12


def test_a_vehicle_in_another_place_is_reported(
    hall: Hall,
) -> None:
    slam = OnlineSlam(calibrated(hall[0]), OPTIONS, dipole_world(7))
    run = driven(slam, messages(hall[1].recording))
    assert EventKind.READINGS_REFUSED in run.kinds


def test_a_start_is_searched_for_on_line() -> None:
    """Odometry in a frame of its own; killed while the search waits for path, and resumed."""
    world = strange_hall(0)
    sensors, drive = lost_drive(world, 0)
    options, field_map = searching(), surveyed(world)
    given = list(messages(drive.recording))
    slam = OnlineSlam(calibrated(sensors), options, field_map)
    assert [pose for message in given[:300] for pose in give(slam, message)] == []
    slam = resumed_slam(saved_state(slam), calibrated(sensors), options, field_map)
    run = driven(slam, given[300:])
    assert run.kinds[0] is EventKind.RESUMED
    assert EventKind.START_FOUND in run.kinds
    stamps = run.trajectory().stamp_ns
    assert stamps[0] == drive.recording.trajectory.stamp_ns[0]
    assert np.sqrt(np.mean(run.off(drive.truth) ** 2)) < 0.1
    assert run.nees(drive.truth).mean() < 12


@pytest.mark.parametrize("broken", ["silent", "not a number"])
def test_a_search_for_the_start_begins_with_readings(broken: str) -> None:
    """No sensor sends for 7 m, or none a number: longer than a window, which has none to match."""
    world = strange_hall(0)
    sensors, drive = lost_drive(world, 0)
    options = searching(window_m=4.0)
    slam = OnlineSlam(calibrated(sensors), options, surveyed(world))

    def late(reading: FieldReading) -> FieldReading | None:
        if seconds_of(drive.recording, reading.stamp_ns) > 12:
            return reading
        return None if broken == "silent" else replace(reading, field=np.full(3, np.nan))

    run = driven(slam, with_readings(messages(drive.recording), late))
    assert EventKind.START_FOUND in run.kinds
    first = seconds_of(drive.recording, int(run.trajectory().stamp_ns[0]))
    assert 9 < first < 12  # a metre before the first reading at most
    assert np.sqrt(np.mean(run.off(drive.truth) ** 2)) < 0.1
    assert run.nees(drive.truth).mean() < 12


def test_a_search_without_readings_ends_without_poses() -> None:
    world = strange_hall(0)
    sensors, drive = lost_drive(world, 0, seconds=20)
    slam = OnlineSlam(calibrated(sensors), searching(window_m=4.0), surveyed(world))
    run = driven(slam, with_readings(messages(drive.recording), lambda _: None))
    assert run.poses == ()
    assert "there are no readings" in run.texts(EventKind.START_OPEN)[-1]


@pytest.mark.parametrize("has_map", [True, False])
def test_refined_calibrations_are_handed_out_with_what_is_known_of_them_then(
    has_map: bool,
) -> None:
    """Not with the covariances that they had before the drive."""
    sensors, off = random_sensors(3, 3), np.repeat([5e-3, 5e-3, 0.3], [3, 9, 3])
    known = calibrated(sensors, sigma=off, rng=np.random.default_rng(5))
    options = SlamOptions.model_validate(
        {
            "key_poses": COARSE,
            "calibration": "refined",
            "tiles": {"modes": 50, "learn_over_m": 5.0},
        }
    )
    world = dipole_world(3)
    recorded = slam_drive(world, sensors, laps(25, (1.9, 1.4)), np.random.default_rng(3))
    slam = OnlineSlam(known, options, world if has_map else None)
    last = driven(slam, messages(recorded.recording)).poses[-1]
    assert isinstance(slam.estimator, Explorer | BranchedFollower)
    own = slam.estimator.belief.calibration_covariance
    np.testing.assert_array_equal(last.sensors.covariance, own)
    assert last.covariance.base is None  # of the whole covariance, which it would keep
    offset = np.sqrt(np.einsum("sii->si", own)[:, 12:])
    assert (offset < 0.9 * 0.3).all()  # H is learnt, by a tenth of its sigma at least


def test_what_is_kept_does_not_grow_with_the_drive(
    hall: Hall,
) -> None:
    """In a map: the state after each quarter of a drive, and a vehicle parked for half an hour."""
    given, sizes = list(messages(hall[1].recording)), list[int]()
    slam = in_map(hall)
    for number, message in enumerate(given):
        give(slam, message)
        if (number + 1) % (len(given) // 4) == 0:
            sizes.append(sum(each.nbytes for each in saved_state(slam).arrays.values()))
    # Bytes: of what is known, and of poses and readings that wait for their key pose.
    assert max(sizes) < 10_000
    assert sizes[-1] < sizes[0]
    last = hall[1].recording.trajectory
    T, end = RigidTransform(last.R[-1], last.p[-1]), int(last.stamp_ns[-1])
    for k in range(1, 4501):
        stamp = end + k * 400_000_000
        for sensor in hall[0]:
            slam.add_reading(stamp, sensor.sensor, np.array([20.0, 0.0, -40.0]))
        assert slam.add_odometry(OdometryPose(stamp + 1, T)) == () or k <= 1
    assert len(slam.intake.state.poses) <= 513
    assert max(len(each.stamp_ns) for each in slam.intake.state.sensors) <= 513
