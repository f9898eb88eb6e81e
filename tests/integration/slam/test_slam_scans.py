"""Drives with point clouds beside drifting odometry: fixes, loops and magnetometers together."""

from dataclasses import replace

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
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.records.scans import ScanEvidence
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.odometry import scan_odometry
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import messages, with_scans
from l2m_gtsam.slam.online.scan_matcher import ScanMatcher
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions, TileOptions
from l2m_gtsam.storage.cloud import thinned_cloud
from tests.drives.online import driven
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


def fixes(room: Room, drive: SlamDrive, seed: int = 5) -> ScanEvidence:
    """Return what scans say of a drive, on a cloud that was mapped at its true poses."""
    rng, truth = np.random.default_rng(seed), drive.truth
    mapping, seen = rows(truth, range(0, len(truth), 100)), rows(truth, range(1, len(truth), EVERY))
    points = [
        scan.points @ mapping.R[k].T + mapping.p[k]
        for k, scan in enumerate(scans(room, mapping, rng))
    ]
    cloud = Surface(smoothed(thinned_cloud(np.concatenate(points), 0.1)))
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
    seen = rows(truth, range(1, len(truth), EVERY))
    steps = scan_odometry(scans(ROOM, seen, rng), mended(drive), 0.25, OPTIONS)
    loops = ScanEvidence(loops=find_loop_closures(steps, LoopOptions()).loops)
    assert len(loops) > 10
    # Tiles that are a little larger than by default, and fewer key poses: a third of the time.
    coarse = {"tiles": TileOptions(core=4.0), "key_poses": FAR_APART}
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
    seen = rows(drive.truth, range(1, len(drive.truth), EVERY))
    found = scans(CORRIDOR, replace(seen, p=seen.p * [1.0, 0.3, 1.0]), np.random.default_rng(7))
    steps = scan_odometry(found, mended(drive), 0.25, OPTIONS)
    assert find_loop_closures(steps, LoopOptions()).loops == ()


def test_scans_are_fixes_on_line_and_one_that_lies_is_left_out(
    hall: tuple[tuple[KnownSensor, ...], SlamDrive],
) -> None:
    """Every fourth scan is seen 1.2 m to the side, as by a wrong transform: none of them counts."""
    known, drive = hall
    rng, truth = np.random.default_rng(5), drive.truth
    mapping, seen = rows(truth, range(0, len(truth), 100)), rows(truth, range(1, len(truth), EVERY))
    points = [
        scan.points @ mapping.R[k].T + mapping.p[k]
        for k, scan in enumerate(scans(ROOM, mapping, rng))
    ]
    cloud = Surface(smoothed(thinned_cloud(np.concatenate(points), 0.1)))
    matcher = ScanMatcher(cloud, ScanLocalisationOptions(), 0.25, OPTIONS.drift)
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
