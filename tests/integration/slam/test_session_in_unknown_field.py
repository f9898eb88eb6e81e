"""Drives through unknown fields, localised message by message."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import FieldReading, give, messages
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from tests.drives.online import driven, seconds_of, with_readings
from tests.drives.slam import COARSE, calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors


def test_without_a_map_it_is_the_explorer_and_it_resumes() -> None:
    """Two laps of 10 m: what comes out is what the same key poses give at once, resumed or not."""
    options = SlamOptions.model_validate(
        {
            "key_poses": {"distance_m": 0.3, "readings": 2},
            "tiles": {"modes": 60, "learn_over_m": 9.0},
        }
    )
    sensors = random_sensors(3, 6)
    recorded = slam_drive(dipole_world(3), sensors, laps(36, (1.9, 1.4)), np.random.default_rng(3))
    given = list(messages(recorded.recording))
    plain = OnlineSlam(calibrated(sensors), options)
    whole = driven(plain, given)
    assert whole.kinds == [EventKind.FIELD_LEARNT]
    odometry = recorded.recording.trajectory
    rows = np.searchsorted(odometry.stamp_ns, whole.trajectory().stamp_ns)
    drift = np.linalg.norm(odometry.p[rows] - recorded.truth.p[rows], axis=1)
    last = len(rows) // 3
    off = whole.off(recorded.truth)
    assert np.sqrt(np.mean(off[-last:] ** 2)) < 0.5 * np.sqrt(np.mean(drift[-last:] ** 2))
    assert whole.nees(recorded.truth)[1:].mean() < 12
    points, field = explored_field(plain)
    truth = dipole_world(3).field_and_gradient(points)[0]
    assert np.sqrt(np.mean((field - truth) ** 2)) < 1.0
    for at in (len(given) // 5, 2 * len(given) // 3):  # before the field is learnt, and after
        slam = OnlineSlam(calibrated(sensors), options)
        for message in given[:at]:
            give(slam, message)
        slam.events()  # or the field that was learnt before would be reported after
        slam = resumed_slam(saved_state(slam), calibrated(sensors), options)
        run = driven(slam, given[at:])
        rows = np.searchsorted(whole.trajectory().stamp_ns, run.trajectory().stamp_ns)
        if EventKind.FIELD_LEARNT in run.kinds:
            np.testing.assert_allclose(run.trajectory().p, whole.trajectory().p[rows], atol=1e-9)
        # Sections begin elsewhere: poses stay linearised where these closed.
        errors = (np.sqrt(np.mean(each**2)) for each in (run.off(recorded.truth), off[rows]))
        assert next(errors) < 1.5 * next(errors)
        assert run.nees(recorded.truth).mean() < 12


QUICK = SlamOptions.model_validate(
    {
        "key_poses": {"distance_m": 0.3, "readings": 2},
        "tiles": {"modes": 60, "learn_over_m": 6.0},
        "whole_field": {"waves": 50, "solve_after_m": 6.0},
    }
)


@pytest.mark.parametrize("count", [1, 2])
def test_sensors_that_begin_late_learn_the_field_when_there_are_readings(count: int) -> None:
    """Silent for 9 m, longer than the field is learnt over: odometry until 6 m with readings."""
    sensors = random_sensors(3, count)
    recorded = slam_drive(dipole_world(3), sensors, laps(36, (1.9, 1.4)), np.random.default_rng(3))
    given = messages(recorded.recording)

    def late(reading: FieldReading) -> FieldReading | None:
        return reading if seconds_of(recorded.recording, reading.stamp_ns) > 15 else None

    run = driven(OnlineSlam(calibrated(sensors), QUICK), with_readings(given, late))
    (learnt,) = [each for each in run.events if each.kind is EventKind.FIELD_LEARNT]
    assert 22 < seconds_of(recorded.recording, learnt.stamp_ns) < 27
    assert run.off(recorded.truth).max() < 0.5
    assert run.nees(recorded.truth)[1:].mean() < 12
    assert run.trajectory().stamp_ns[-1] == recorded.truth.stamp_ns[-1]


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("readings", [0, 3])
def test_with_too_few_readings_to_learn_from_poses_are_odometrys(count: int, readings: int) -> None:
    sensors = random_sensors(3, count)
    recorded = slam_drive(dipole_world(3), sensors, laps(20, (1.9, 1.4)), np.random.default_rng(3))
    left = iter(range(readings))

    def few(reading: FieldReading) -> FieldReading | None:
        return None if next(left, None) is None else reading

    given = with_readings(messages(recorded.recording), few)
    run = driven(OnlineSlam(calibrated(sensors), QUICK), given)
    assert EventKind.FIELD_LEARNT not in run.kinds
    odometry = recorded.recording.trajectory
    rows = np.searchsorted(odometry.stamp_ns, run.trajectory().stamp_ns)
    relative = odometry.R[0].T @ (odometry.p[rows] - odometry.p[0]).T
    first = run.poses[0].T_map_lidar
    np.testing.assert_allclose(run.trajectory().p, (first.R @ relative).T + first.t, atol=1e-6)


def test_one_sensor_in_an_unknown_field_is_reported_at_once() -> None:
    """On a recorded ship such poses end further off than odometry's: docs/studies/slam."""
    sensors = random_sensors(2, 1)
    recorded = slam_drive(dipole_world(2), sensors, laps(3, (1.9, 1.4)), np.random.default_rng(2))
    slam = OnlineSlam(calibrated(sensors), SlamOptions.model_validate({"key_poses": COARSE}))
    for message in messages(recorded.recording):
        give(slam, message)
    (event,) = slam.events()
    assert event.kind is EventKind.ONE_SENSOR
    assert "localise the recorded drive off line" in event.text


def explored_field(slam: OnlineSlam) -> tuple[FloatArray, FloatArray]:
    assert isinstance(slam.estimator, Explorer)
    return slam.estimator.field_along_path()
