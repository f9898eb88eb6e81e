"""Messages on line that are late, ahead, twice there, or none at all."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.errors import CalibrationError, InputError
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.records.sensor_models import MovingField
from l2m_gtsam.slam.localisation import usable_sensors
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.online.online_pose import OnlinePose
from l2m_gtsam.slam.online.replay import FieldReading, Message, messages
from l2m_gtsam.slam.online.session import OnlineSlam
from tests.drives.online import (
    OPTIONS,
    WORLD,
    Hall,
    OnlineRun,
    driven,
    in_map,
)
from tests.drives.slam import calibrated

CURRENT = MovingField("current", np.ones(3), np.ones(3))


def test_stamps_out_of_order_are_left_out(hall: Hall, plain: OnlineRun) -> None:
    """Every fifth pose and reading comes a second time, a second later; one reading is of 2099."""
    drive, old = hall[1], list[OdometryPose | FieldReading]()
    given: list[OdometryPose | FieldReading] = []
    for number, message in enumerate(messages(drive.recording)):
        given.append(message)
        if number % 5 == 0:
            old.append(message)
        if len(old) > 12:
            given.append(old.pop(0))
        if number == 900:
            name = hall[0][0].sensor
            given.append(FieldReading(4_070_908_800_000_000_000, name, np.full(3, 20.0)))
    run = driven(in_map(hall), given)
    assert set(run.kinds) == {EventKind.OUT_OF_ORDER}
    assert any("ahead of odometry" in each.text for each in run.events)
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


@pytest.mark.parametrize("ahead_s", [0.3, 2.0, 9.0])
def test_a_pose_that_is_stamped_ahead_is_taken_back(
    hall: Hall, plain: OnlineRun, ahead_s: float
) -> None:
    given = list(messages(hall[1].recording))
    at = next(n for n, each in enumerate(given) if n > 600 and isinstance(each, OdometryPose))
    ahead = replace(given[at], stamp_ns=given[at].stamp_ns + round(1e9 * ahead_s))
    run = driven(in_map(hall), [*given[:at], ahead, *given[at:]])
    assert set(run.kinds) <= {EventKind.OUT_OF_ORDER, EventKind.ODOMETRY_JUMP}
    assert run.kinds.count(EventKind.OUT_OF_ORDER) == 1
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


def test_a_late_pose_at_the_end_takes_nothing_back(hall: Hall, plain: OnlineRun) -> None:
    given = list(messages(hall[1].recording))
    last = next(each for each in reversed(given) if isinstance(each, OdometryPose))
    run = driven(in_map(hall), [*given, replace(last, stamp_ns=last.stamp_ns - 1_000_000)])
    assert run.kinds == [EventKind.OUT_OF_ORDER]
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


def test_a_first_message_of_another_year_is_taken_back(hall: Hall, plain: OnlineRun) -> None:
    given, late = list(messages(hall[1].recording)), 4_070_908_800_000_000_000
    first = next(each for each in given if isinstance(each, OdometryPose))
    reading = FieldReading(late, hall[0][0].sensor, np.ones(3))
    run = driven(in_map(hall), [reading, replace(first, stamp_ns=late), *given])
    assert run.kinds.count(EventKind.OUT_OF_ORDER) == 2
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (
            {"moving": (CURRENT,)},
            "a part of its readings follows current, which is not known (`bag.regressors`)",
        ),
        ({"status": SensorStatus.AMBIGUOUS, "noise": np.nan}, "its calibration is ambiguous"),
        ({"sensor": "other"}, "it has no calibration"),
    ],
)
def test_a_sensor_is_left_out_on_line_for_the_reason_of_off_line(
    hall: Hall, changed: dict[str, Any], reason: str
) -> None:
    known, recording = calibrated(hall[0]), hall[1].recording
    first, second = known.sensors
    left = replace(known, sensors=(first, replace(second, **changed)))
    _, told = usable_sensors(recording, left)
    assert told == (f"{second.sensor} is left out: {reason}",)
    run = driven(OnlineSlam(left, OPTIONS, WORLD), list(messages(recording))[:300])
    assert tuple(run.texts(EventKind.UNUSABLE)) == told


def test_why_no_sensor_can_be_used_is_said(hall: Hall) -> None:
    known = calibrated(hall[0])
    none = replace(known, sensors=tuple(replace(e, moving=(CURRENT,)) for e in known.sensors))
    with pytest.raises(CalibrationError, match=r"can be used: mag_00 is left out: a part of its"):
        OnlineSlam(none, OPTIONS, WORLD)


@pytest.mark.parametrize("factor", [1e3, 1e-2])
def test_readings_in_another_unit_are_left_out(hall: Hall, factor: float) -> None:
    """One sensor reads in nanotesla or in gauss: as if it sent nothing."""
    name, given, without = hall[0][0].sensor, list[Message](), list[Message]()
    for each in messages(hall[1].recording):
        if isinstance(each, FieldReading) and each.sensor == name:
            given.append(replace(each, field=factor * each.field))
        else:
            given.append(each)
            without.append(each)
    run, silent = driven(in_map(hall), given), driven(in_map(hall), without)
    (text,) = run.texts(EventKind.UNUSABLE)
    assert name in text
    assert "unit" in text
    np.testing.assert_array_equal(run.trajectory().p, silent.trajectory().p)


def test_odometry_of_single_precision_in_a_buffer_that_is_used_again(
    hall: Hall, plain: OnlineRun
) -> None:
    """Rotations off by 1e-4, as products of float32 become: as without to a millimetre."""
    slam, R, t, b = in_map(hall), np.eye(3), np.zeros(3), np.zeros(3)
    poses = list[OnlinePose]()
    for each in messages(hall[1].recording):
        if isinstance(each, OdometryPose):
            R[:], t[:] = (1 + 1e-4) * each.T.R, each.T.t
            poses += slam.add_odometry(replace(each, T=RigidTransform(R, t)))
        else:
            b[:] = each.field
            slam.add_reading(each.stamp_ns, each.sensor, b)
    found = np.stack([each.T_map_lidar.t for each in poses])
    np.testing.assert_allclose(found, plain.trajectory().p[: len(found)], atol=1e-3)
    R = poses[-1].T_map_lidar.R
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)  # rounding of many compositions


def test_what_is_no_message_is_refused_at_the_door(
    hall: Hall,
) -> None:
    slam, name = in_map(hall), hall[0][0].sensor
    still = RigidTransform(np.eye(3), np.zeros(3))
    with pytest.raises(InputError, match=r"of shape \(2, 3\); needed is \(3,\)"):
        slam.add_reading(1, name, np.zeros((2, 3)))
    with pytest.raises(InputError, match="needed are nanoseconds as an integer"):
        slam.add_reading(1.5, name, np.zeros(3))  # type: ignore[arg-type]  # the fault
    matrix = OdometryPose(1, np.eye(4))  # type: ignore[arg-type]  # the fault
    for pose, told in (
        (matrix, "T is a ndarray; needed is a RigidTransform"),
        (OdometryPose(1, still, np.zeros(6)), r"covariance is \(6,\)"),
        (OdometryPose(1, RigidTransform(np.eye(3), np.zeros((3, 1)))), r"T.t is \(3, 1\)"),
    ):
        with pytest.raises(InputError, match=told):
            slam.add_odometry(pose)


def test_a_slip_is_reported_and_what_is_no_pose_is_refused(
    hall: Hall,
) -> None:
    """The wheels slip by 20 cm at 10 s; a pose is NaN, a rotation is none."""
    drive = hall[1]
    odometry = drive.recording.trajectory
    p = odometry.p.copy()
    p[200:] += np.array([0.15, 0.13, 0.0])
    given = list(messages(replace(drive.recording, trajectory=replace(odometry, p=p))))
    bad = OdometryPose(int(odometry.stamp_ns[300]), RigidTransform(np.eye(3), np.full(3, np.nan)))
    worse = replace(bad, T=RigidTransform(2 * np.eye(3), np.zeros(3)))
    run = driven(in_map(hall), [*given[:600], bad, worse, *given[600:]])
    assert run.kinds.count(EventKind.ODOMETRY_JUMP) == 1
    assert run.kinds.count(EventKind.UNUSABLE) == 2
    assert np.sqrt(np.mean(run.off(drive.truth) ** 2)) < 0.06  # as without
    assert run.nees(drive.truth)[1:].mean() < 12


def spoilt(
    given: list[OdometryPose | FieldReading], seed: int
) -> list[OdometryPose | FieldReading]:
    """Return messages of which some are lost, late, twice there, not finite, or of another year."""
    rng, found = np.random.default_rng(seed), list[OdometryPose | FieldReading]()
    for message in given:
        change = rng.integers(0, 60)  # six kinds of faults
        if change == 0:
            continue
        if change == 1 and found:
            found.insert(max(len(found) - int(rng.integers(1, 40)), 0), message)
            continue
        if change == 2:
            found.append(message)
        if change == 3:
            message = replace(message, stamp_ns=int(rng.integers(-(2**60), 2**62)))
        if change == 4 and isinstance(message, FieldReading):
            message = replace(message, field=message.field * rng.choice([np.nan, np.inf, 1e9, 0.0]))
        if change == 5 and isinstance(message, OdometryPose):
            message = replace(message, covariance=np.full((6, 6), np.nan))
        found.append(message)
    return found


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_poses_are_finite_and_sigmas_hold(hall: Hall, seed: int) -> None:
    """A tenth of all messages is spoilt; the first pose is right."""
    first, *rest = list(messages(hall[1].recording))
    run = driven(in_map(hall), [first, *spoilt(rest, seed)])
    found = run.trajectory()
    assert np.all(np.diff(found.stamp_ns) > 0)
    assert found.covariance is not None
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)
    assert run.nees(hall[1].truth)[1:].mean() < 12
    assert run.events
