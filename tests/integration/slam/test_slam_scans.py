"""Drives with point clouds beside drifting odometry: fixes, loops and magnetometers together."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from l2m_gtsam.data import KnownSensor, RigidTransform, Trajectory
from l2m_gtsam.geometry import compose
from l2m_gtsam.lidar.loop_closures import LoopOptions, find_loop_closures
from l2m_gtsam.lidar.registration import PoseEstimate, RegistrationOptions
from l2m_gtsam.lidar.scan_localisation import ScanLocalisationOptions, localise_scans, spaced
from l2m_gtsam.lidar.surface import Surface, smoothed
from l2m_gtsam.progress import silent
from l2m_gtsam.recording.odometry_jumps import RepairedOdometry, without_jumps
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.records.scans import ScanEvidence
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.odometry import scan_odometry
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import Message, give, messages, with_scans
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.scan_matching import CONTRADICTS, LoopMatcher, ScanMatcher
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, TileOptions
from l2m_gtsam.slam.unknown_field.explorer import Explorer
from l2m_gtsam.storage.cloud import thinned_cloud
from tests.drives.exploring import rms
from tests.drives.online import OnlineRun, driven
from tests.drives.slam import COARSE, SlamDrive, calibrated, laps, rounds, slam_drive
from tests.support.pose_errors import pose_nees, position_error
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.lidar_rooms import CORRIDOR, Room, rows, scans

ROOM = Room(
    ((-6.0, -5.0, 0.0), (8.0, 7.0, 3.5)),
    (((5.5, -4.0, 0.0), (6.0, -3.0, 3.5)), ((4.5, 4.5, 0.0), (5.5, 5.5, 2.0))),
)
OPTIONS = SlamOptions(key_poses=COARSE)
FAR_APART = COARSE.model_copy(update={"distance_m": 0.5})
REGISTRATION = RegistrationOptions(unseen_m=100.0, unseen_deg=100.0)
EVERY = 15  # poses: a scan each 0.75 s


def mended(drive: SlamDrive) -> RepairedOdometry:
    """Return a drive's odometry, which does not jump."""
    return without_jumps(drive.recording.trajectory, OPTIONS.jumps)


def drive_of(
    seed: int, truth: Trajectory, sensors: int = 1
) -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    known = random_sensors(seed, sensors)
    return known, slam_drive(dipole_world(1), known, truth, np.random.default_rng(seed))


def scanned(truth: Trajectory) -> Trajectory:
    """Return the poses of a drive's scans."""
    return rows(truth, range(1, len(truth), EVERY))


def mapped(room: Room, truth: Trajectory, rng: np.random.Generator) -> Surface:
    """Return the cloud of a room from a few of a drive's true poses."""
    mapping = rows(truth, range(0, len(truth), 100))
    points = [
        scan.points @ mapping.R[k].T + mapping.p[k]
        for k, scan in enumerate(scans(room, mapping, rng))
    ]
    return Surface(smoothed(thinned_cloud(np.concatenate(points), 0.1)))


def fixes(room: Room, drive: SlamDrive, seed: int = 5) -> ScanEvidence:
    """Return what scans say of a drive, on a cloud that was mapped at its true poses."""
    rng, seen = np.random.default_rng(seed), scanned(drive.truth)
    cloud = mapped(room, drive.truth, rng)
    steps = scan_odometry(scans(room, seen, rng), mended(drive), 0.25, OPTIONS)
    options = ScanLocalisationOptions(registration=REGISTRATION)
    start = PoseEstimate(RigidTransform(seen.R[0], seen.p[0]), 1e-2 * np.eye(6))
    found = localise_scans(steps, cloud, start, options)
    return ScanEvidence(fixes=spaced(found.fixes, OPTIONS.key_poses.distance_m, options))


def found_by(
    drive: SlamDrive, known: tuple[KnownSensor, ...], seen: ScanEvidence
) -> LocalisationResult:
    world = dipole_world(1)
    return localise(
        drive.recording, world, calibrated(known), OPTIONS, silent, evidence=seen
    ).result


@pytest.fixture(scope="module")
def hall() -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    """Thirty metres with odometry that slips by 1 %."""
    return drive_of(21, rounds(50))


@pytest.fixture(scope="module")
def in_hall(hall: tuple[tuple[KnownSensor, ...], SlamDrive]) -> ScanEvidence:
    return fixes(ROOM, hall[1])


def test_fixes_hold_a_drive_where_they_are(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], in_hall: ScanEvidence
) -> None:
    """Centimetres, as between fixes odometry slips, and no more than the sigmas say."""
    known, drive = hall
    result = found_by(drive, known, in_hall)
    assert result.scans is not None
    assert result.by_scans is not None
    assert (result.scans.fixes, result.scans.rejected) == (len(in_hall), 0)
    assert position_error(drive.truth, result.odometry) > 0.1
    assert position_error(drive.truth, result.by_scans) < 0.02
    assert position_error(drive.truth, result.trajectory) < 0.015
    assert pose_nees(drive.truth, result.trajectory).mean() < 8


def test_wrong_fixes_are_left_out_and_counted(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive], in_hall: ScanEvidence
) -> None:
    """A quarter of the scans was registered in the next aisle."""
    known, drive = hall
    aisle = RigidTransform(np.eye(3), np.array([0.0, 2.8, 0.0]))
    wrong = [
        replace(each, T_map_lidar=compose(aisle, each.T_map_lidar)) if k % 4 == 2 else each
        for k, each in enumerate(in_hall.fixes)
    ]
    result = found_by(drive, known, ScanEvidence(fixes=tuple(wrong)))
    assert result.scans is not None
    assert result.scans.rejected == sum(k % 4 == 2 for k in range(len(wrong)))
    assert position_error(drive.truth, result.trajectory) < 0.015


def test_where_scans_slip_magnetometers_hold() -> None:
    """A corridor that looks the same everywhere, along which odometry slips."""
    known, drive = drive_of(22, rounds(30), sensors=2)
    wide = Room(((-4.5, -500.0, 0.0), (4.5, 500.0, 2.8)))
    seen = fixes(wide, drive)
    result = found_by(drive, known, seen)
    assert result.scans is not None
    assert result.by_scans is not None
    before = position_error(drive.truth, result.odometry)
    assert position_error(drive.truth, result.by_scans) > 0.6 * before
    assert position_error(drive.truth, result.trajectory) < 0.05
    assert pose_nees(drive.truth, result.trajectory).mean() < 12


def test_loops_of_scans_help_where_nothing_is_mapped() -> None:
    """Two laps of 21 m; a third of each is seen again."""
    known, drive = drive_of(23, laps(75), sensors=2)
    rng, truth = np.random.default_rng(6), drive.truth
    seen = scanned(truth)
    steps = scan_odometry(scans(ROOM, seen, rng), mended(drive), 0.25, OPTIONS)
    loops = ScanEvidence(loops=find_loop_closures(steps, LoopOptions()))
    assert len(loops) > 10
    # Tiles that are a little larger than by default, and fewer key poses: a third of the time.
    coarse = {"tiles": TileOptions(core=4.0, modes=100), "key_poses": FAR_APART}
    options = OPTIONS.model_copy(update=coarse)
    found = explore(drive.recording, calibrated(known), options, silent, evidence=loops).result
    assert found.scans is not None
    assert found.by_scans is not None
    assert (found.scans.loops, found.scans.rejected) == (len(loops), 0)
    before = position_error(truth, found.odometry)
    assert position_error(truth, found.by_scans) < 0.5 * before
    assert position_error(truth, found.trajectory) < 0.35 * before


def test_a_corridor_closes_no_loop() -> None:
    """One part of it looks like another: what determines no place is not believed."""
    _, drive = drive_of(24, rounds(40))
    seen = scanned(drive.truth)
    found = scans(CORRIDOR, replace(seen, p=seen.p * [1.0, 0.3, 1.0]), np.random.default_rng(7))
    steps = scan_odometry(found, mended(drive), 0.25, OPTIONS)
    assert find_loop_closures(steps, LoopOptions()) == ()


def test_scans_are_fixes_on_line_and_one_that_lies_is_left_out(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
) -> None:
    """Every fourth scan is seen 1.2 m to the side, as by a wrong transform: none of them counts."""
    known, drive = hall
    rng, truth = np.random.default_rng(5), drive.truth
    cloud, seen = mapped(ROOM, truth, rng), scanned(truth)
    matcher = ScanMatcher(cloud, ScanLocalisationOptions(), OPTIONS.drift)
    lying = [
        replace(each, points=each.points + np.array([0.0, 1.2, 0.0])) if k % 4 == 3 else each
        for k, each in enumerate(scans(ROOM, seen, rng))
    ]
    slam = OnlineSlam(calibrated(known), OPTIONS, dipole_world(1), matcher)
    run = driven(slam, with_scans(messages(drive.recording), lying))
    assert len(run.texts(EventKind.SCAN_REFUSED)) == len(lying) // 4
    late = run.off(truth)[20:]
    assert np.sqrt(np.mean(late**2)) < 0.03
    assert run.nees(truth)[20:].mean() < 12


@dataclass(frozen=True)
class LoopsOnLine:
    """A drive on line without a map, its scans among the messages, and where it truly was."""

    given: list[Message]
    drive: SlamDrive
    calibration: CalibrationResult
    options: SlamOptions

    def slam(self) -> OnlineSlam:
        """Return a localisation that closes loops."""
        largest = self.options.robust.largest_of(6)
        matcher = LoopMatcher(LoopOptions(), self.options.drift, largest)
        return OnlineSlam(self.calibration, self.options, None, matcher)


@pytest.fixture(scope="module")
def revisiting() -> LoopsOnLine:
    """Two laps of 21 m and a bit, two sensors off by millimetres, a scan each 0.75 s.

    Every fourth scan of the second lap is seen 1.5 m to the side, as by a wrong transform.
    """
    known, drive = drive_of(24, laps(80), sensors=2)
    rng, truth = np.random.default_rng(6), drive.truth
    seen = scanned(truth)
    aside = np.array([0.0, 1.5, 0.0])
    lying = [
        replace(each, points=each.points + aside) if k % 4 == 3 and k > 60 else each
        for k, each in enumerate(scans(ROOM, seen, rng))
    ]
    options = OPTIONS.model_copy(
        update={
            "tiles": TileOptions(modes=100),
            "key_poses": FAR_APART,
            "calibration": CalibrationUse.REFINED,
        }
    )
    given = list(with_scans(messages(drive.recording), lying))
    sigma = np.concatenate([np.full(3, 0.005), np.full(9, 0.005), np.full(3, 0.3)])
    return LoopsOnLine(given, drive, calibrated(known, sigma=sigma, rng=rng), options)


@pytest.fixture(scope="module")
def whole_run(revisiting: LoopsOnLine) -> tuple[OnlineSlam, OnlineRun]:
    slam = revisiting.slam()
    return slam, driven(slam, revisiting.given)


def test_loops_of_scans_take_the_drift_out_on_line_without_a_map(
    revisiting: LoopsOnLine, whole_run: tuple[OnlineSlam, OnlineRun]
) -> None:
    """On the second lap a fifth of the drift is left at most, though some scans lie."""
    run, truth, odometry = whole_run[1], revisiting.drive.truth, revisiting.drive.recording
    at = np.searchsorted(truth.stamp_ns, run.trajectory().stamp_ns)
    drift = np.linalg.norm(odometry.trajectory.p[at] - truth.p[at], axis=1)
    late = len(at) // 3
    assert rms(run.off(truth)[-late:]) < rms(drift[-late:]) / 5
    assert run.nees(truth)[1:].mean() < 12
    assert CONTRADICTS in run.texts(EventKind.SCAN_REFUSED)


def test_scans_are_kept_per_place(whole_run: tuple[OnlineSlam, OnlineRun]) -> None:
    """None was taken nearer than a metre to one before it, as they were placed then."""
    matcher, explorer = whole_run[0].matcher, whole_run[0].estimator
    assert isinstance(matcher, LoopMatcher)
    assert isinstance(explorer, Explorer)
    p = np.stack([explorer.estimate(each.key_pose).T.t for each in matcher.kept])
    apart = np.linalg.norm(p[:, None] - p, axis=2) + 10 * np.eye(len(p))
    assert apart.min() > 0.7  # poses were corrected since the first of two was kept
    assert len(p) < 22  # of 49 m
    ahead = [each.key_pose for each in matcher.kept]
    assert ahead == sorted(ahead)


def test_loops_go_on_after_a_state_was_saved(
    revisiting: LoopsOnLine, whole_run: tuple[OnlineSlam, OnlineRun]
) -> None:
    """A state by way of arrays, after the first lap: the second closes loops with it as before."""
    given, half = revisiting.given, len(revisiting.given) // 2
    before, after = revisiting.slam(), revisiting.slam()
    for message in given[:half]:
        give(before, message)
    state = saved_state(before)
    assert before.matcher is not None
    anew = resumed_slam(state, revisiting.calibration, revisiting.options, matcher=after.matcher)
    run = driven(anew, given[half:])
    truth = revisiting.drive.truth
    late = len(run.poses) // 2
    off = [rms(each.off(truth)[-late:]) for each in (run, whole_run[1])]
    # Sections begin elsewhere: poses stay linearised where these closed.
    assert off[0] < 1.5 * off[1] + 0.01
    assert run.nees(truth).mean() < 12
