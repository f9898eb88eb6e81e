"""Drives localised message by message, and what goes wrong on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, KnownSensor, RigidTransform
from l2m_gtsam.errors import ConfigError, InputError
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.follower import Follower
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, key_poses_of
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.online.replay import FieldReading, give, messages
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.session import OnlinePose, OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from l2m_gtsam.storage.online_log import SavedState, read_state, write_state
from tests.drives.lost import QUICK, lost_drive, searching
from tests.drives.online import OnlineRun, driven, seconds_of, with_readings
from tests.drives.slam import COARSE, SlamDrive, calibrated, laps, slam_drive, small_hall
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.surveyed import strange_hall, surveyed, wandering

WORLD, OPTIONS = dipole_world(1), SlamOptions.model_validate({"key_poses": COARSE})
SECONDS = 25.0
GAP = (200, 260)  # rows of odometry


@pytest.fixture(scope="module")
def hall() -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    """Two sensors, 15 m, odometry that slips by 1 % of the path."""
    return small_hall(21, seconds=SECONDS)


@pytest.fixture(scope="module")
def plain(hall: tuple[tuple[KnownSensor, ...], SlamDrive]) -> OnlineRun:
    return driven(in_map(hall), messages(hall[1].recording))


def in_map(hall: tuple[tuple[KnownSensor, ...], SlamDrive]) -> OnlineSlam:
    return OnlineSlam(calibrated(hall[0]), OPTIONS, WORLD)


def test_a_drive_is_localised_as_it_comes(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun
) -> None:
    truth = hall[1].truth
    assert np.sqrt(np.mean(plain.off(truth) ** 2)) < 0.06  # the start is known within 0.1 m
    # Poses of one drive err together: no more than twice the six of one pose in the mean.
    assert plain.nees(truth)[1:].mean() < 12
    assert plain.events == ()
    assert plain.trajectory().stamp_ns[-1] == truth.stamp_ns[-1]


def test_key_poses_are_those_of_the_recording(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
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
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
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


def with_gap(drive: SlamDrive, goes_on: bool) -> list[OdometryPose | FieldReading]:
    """Return a drive without odometry for three seconds, which has gone on, or has stood still."""
    odometry, first, last = drive.recording.trajectory, *GAP
    before, after = (RigidTransform(odometry.R[k], odometry.p[k]) for k in GAP)
    found: list[OdometryPose | FieldReading] = []
    for message in messages(drive.recording):
        if not isinstance(message, OdometryPose):
            found.append(message)
            continue
        row = int(np.searchsorted(odometry.stamp_ns, message.stamp_ns))
        if first < row < last:
            continue
        T = message.T
        if row >= last and not goes_on:  # all that follows continues from where it stood
            R = before.R @ after.R.T
            T = RigidTransform(R @ T.R, R @ (T.t - after.t) + before.t)
        found.append(replace(message, T=T))
    return found


def test_a_gap_of_odometry_is_reported_and_its_sigma_says_so(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
) -> None:
    """Odometry has gone on meanwhile: the pose after it is as far off as its sigma says."""
    run, truth = driven(in_map(hall), with_gap(hall[1], goes_on=True)), hall[1].truth
    assert EventKind.ODOMETRY_GAP in run.kinds
    at_end = int(np.searchsorted(run.trajectory().stamp_ns, truth.stamp_ns[GAP[1]]))
    sigma = np.sqrt(np.trace(run.poses[at_end].covariance[3:, 3:]))
    assert run.off(truth)[at_end] < 4 * sigma
    assert run.nees(truth)[1:].mean() < 12
    assert run.off(truth)[-10:].max() < 0.1


def test_where_odometry_stood_still_over_a_gap_the_place_is_searched_for() -> None:
    """The vehicle went on by 1.8 m, odometry did not: no pose comes out until its place is found.

    With a prior as wide as what it may have driven a filter found a wrong place, and was sure.
    """
    world, rng = strange_hall(0), np.random.default_rng(0)
    sensors = random_sensors(0, 2)
    drive = slam_drive(world, sensors, wandering(rng, 40.0), rng)
    options = SlamOptions.model_validate({"key_poses": COARSE, "start": {"search": QUICK}})
    slam = OnlineSlam(calibrated(sensors), options, surveyed(world))
    run, truth = driven(slam, with_gap(drive, goes_on=False)), drive.truth
    gap = run.kinds.index(EventKind.ODOMETRY_GAP)
    assert run.kinds[gap + 1 :][0] is EventKind.START_OPEN
    assert run.kinds[-1] is EventKind.START_FOUND
    assert run.nees(truth)[1:].mean() < 12
    assert run.off(truth)[-10:].max() < 0.1
    assert run.trajectory().stamp_ns[-1] == truth.stamp_ns[-1]


def test_stamps_out_of_order_are_left_out(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun
) -> None:
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
            given.append(FieldReading(4_070_908_800_000_000_000, name, np.zeros(3)))
    run = driven(in_map(hall), given)
    assert set(run.kinds) == {EventKind.OUT_OF_ORDER}
    assert any("ahead of odometry" in each.text for each in run.events)
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


@pytest.mark.parametrize("ahead_s", [0.3, 2.0, 9.0])
def test_a_pose_that_is_stamped_ahead_is_taken_back(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun, ahead_s: float
) -> None:
    given = list(messages(hall[1].recording))
    at = next(n for n, each in enumerate(given) if n > 600 and isinstance(each, OdometryPose))
    ahead = replace(given[at], stamp_ns=given[at].stamp_ns + round(1e9 * ahead_s))
    run = driven(in_map(hall), [*given[:at], ahead, *given[at:]])
    assert set(run.kinds) <= {EventKind.OUT_OF_ORDER, EventKind.ODOMETRY_JUMP}
    assert run.kinds.count(EventKind.OUT_OF_ORDER) == 1
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


def test_a_late_pose_at_the_end_takes_nothing_back(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun
) -> None:
    given = list(messages(hall[1].recording))
    last = next(each for each in reversed(given) if isinstance(each, OdometryPose))
    run = driven(in_map(hall), [*given, replace(last, stamp_ns=last.stamp_ns - 1_000_000)])
    assert run.kinds == [EventKind.OUT_OF_ORDER]
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


def test_a_first_message_of_another_year_is_taken_back(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun
) -> None:
    given, late = list(messages(hall[1].recording)), 4_070_908_800_000_000_000
    first = next(each for each in given if isinstance(each, OdometryPose))
    reading = FieldReading(late, hall[0][0].sensor, np.ones(3))
    run = driven(in_map(hall), [reading, replace(first, stamp_ns=late), *given])
    assert run.kinds.count(EventKind.OUT_OF_ORDER) == 2
    np.testing.assert_array_equal(run.trajectory().p, plain.trajectory().p)


def test_odometry_of_single_precision_in_a_buffer_that_is_used_again(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun
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
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
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
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
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


def test_a_vehicle_in_another_place_is_reported(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
) -> None:
    slam = OnlineSlam(calibrated(hall[0]), OPTIONS, dipole_world(7))
    run = driven(slam, messages(hall[1].recording))
    assert EventKind.READINGS_REFUSED in run.kinds


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
def test_whatever_comes_poses_are_finite_and_sigmas_hold(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], seed: int
) -> None:
    """A tenth of all messages is spoilt; the first pose is right."""
    first, *rest = list(messages(hall[1].recording))
    run = driven(in_map(hall), [first, *spoilt(rest, seed)])
    found = run.trajectory()
    assert np.all(np.diff(found.stamp_ns) > 0)
    assert found.covariance is not None
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)
    assert run.nees(hall[1].truth)[1:].mean() < 12
    assert run.events


def test_killed_and_resumed_it_goes_on(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], plain: OnlineRun, tmp_path: Path
) -> None:
    """Killed at 12 s, resumed from its file: the poses after it are those of a run unbroken.

    The open section is closed for the state, and stays linearised: by a tenth of a sigma.
    """
    sensors, drive = hall
    given = list(messages(drive.recording))
    slam, half = in_map(hall), len(given) // 2
    before = [pose for message in given[:half] for pose in give(slam, message)]
    path = tmp_path / "state.npz"
    write_state(path, saved_state(slam))
    again = resumed_slam(read_state(path), calibrated(sensors), OPTIONS, WORLD)
    run = driven(again, given[half:])
    assert run.kinds == [EventKind.RESUMED]
    whole = OnlineRun((*before, *run.poses), run.events).trajectory()
    expected = plain.trajectory()
    np.testing.assert_array_equal(whole.stamp_ns, expected.stamp_ns)
    assert expected.covariance is not None
    sigma = np.sqrt(np.einsum("kii->ki", expected.covariance[:, 3:, 3:]))
    assert (np.abs(whole.p - expected.p) / sigma).max() < 0.1


def test_a_state_that_knows_no_steady_drift_goes_on(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
) -> None:
    """As it was saved before the drift was followed."""
    sensors, drive = hall
    given = list(messages(drive.recording))
    slam, half = in_map(hall), len(given) // 2
    driven(slam, given[:half])
    state = saved_state(slam)
    arrays = {k: v for k, v in state.arrays.items() if not k.startswith("belief.drift.")}
    assert len(arrays) < len(state.arrays)
    run = driven(
        resumed_slam(SavedState(arrays, state.facts), calibrated(sensors), OPTIONS, WORLD),
        given[half:],
    )
    assert np.sqrt(np.mean(run.off(drive.truth) ** 2)) < 0.06


def test_a_state_of_something_else_is_refused(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], tmp_path: Path
) -> None:
    sensors, drive = hall
    slam = in_map(hall)
    for message in list(messages(drive.recording))[:300]:
        give(slam, message)
    state = saved_state(slam)
    with pytest.raises(ConfigError, match="another calibration"):
        resumed_slam(state, calibrated(sensors[:1]), OPTIONS, WORLD)
    other = OPTIONS.model_copy(update={"max_pose_gap_s": 0.4})
    with pytest.raises(ConfigError, match="another calibration"):
        resumed_slam(state, calibrated(sensors), other, WORLD)
    for name in ("belief.R", "intake.stamp_ns", "base", "belief.covariance"):
        less = SavedState({k: v for k, v in state.arrays.items() if k != name}, state.facts)
        with pytest.raises(ConfigError, match="damaged"):
            resumed_slam(less, calibrated(sensors), OPTIONS, WORLD)
    path = tmp_path / "state.npz"
    write_state(path, state)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="damaged"):
        read_state(path)
    with pytest.raises(ConfigError, match="no such file"):
        read_state(tmp_path / "none.npz")


def test_another_map_or_calibration_than_before_is_refused(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
) -> None:
    """With the same names; states that were saved before these were kept are still read."""
    sensors, drive = hall
    slam = in_map(hall)
    for message in list(messages(drive.recording))[:300]:
        give(slam, message)
    state, known = saved_state(slam), calibrated(sensors)
    for other in (
        calibrated(sensors, sigma=np.full(15, 1e-3), rng=np.random.default_rng(1)),
        calibrated(sensors, sigma=np.full(15, 1e-4)),
    ):
        with pytest.raises(ConfigError, match="another calibration: give that one, or begin"):
            resumed_slam(state, other, OPTIONS, WORLD)
    for elsewhere in (dipole_world(7), None):
        with pytest.raises(ConfigError, match="another map: give that one, or begin"):
            resumed_slam(state, known, OPTIONS, elsewhere)
    arrays = {k: v for k, v in state.arrays.items() if not k.startswith("given.")}
    facts = {k: v for k, v in state.facts.items() if k != "events"}
    resumed_slam(SavedState(arrays, facts), known, OPTIONS, dipole_world(7))


def test_events_that_nobody_has_read_are_saved(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], tmp_path: Path
) -> None:
    slam = in_map(hall)
    for message in list(messages(hall[1].recording))[:300]:
        give(slam, message)
    slam.add_reading(slam.stamp_ns, "unheard_of", np.ones(3))
    write_state(tmp_path / "state.npz", saved_state(slam))
    unread = slam.events()
    assert [each.kind for each in unread] == [EventKind.UNUSABLE]
    saved = read_state(tmp_path / "state.npz")
    again = resumed_slam(saved, calibrated(hall[0]), OPTIONS, WORLD).events()
    assert again[:-1] == unread
    assert again[-1].kind is EventKind.RESUMED


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
    assert isinstance(slam.estimator, Explorer | Follower)
    own = slam.estimator.belief.calibration_covariance
    np.testing.assert_array_equal(last.sensors.covariance, own)
    assert last.covariance.base is None  # of the whole covariance, which it would keep
    offset = np.sqrt(np.einsum("sii->si", own)[:, 12:])
    assert (offset < 0.9 * 0.3).all()  # H is learnt, by a tenth of its sigma at least


def test_what_is_kept_does_not_grow_with_the_drive(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
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
