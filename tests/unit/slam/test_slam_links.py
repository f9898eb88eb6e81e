"""What scans say of key poses: hung on them, believed or not."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray, IntArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import between, compose, difference, perturbed
from l2m_gtsam.lidar.scan_localisation import ScanLocalisationOptions, spaced
from l2m_gtsam.recording.sync import interpolated
from l2m_gtsam.records.scans import LoopClosure, PoseFix, ScanEvidence
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose
from l2m_gtsam.slam.links import MAP, key_pose_links, link_stamps
from l2m_gtsam.slam.odometry import key_pose_rows, odometry_steps, with_rows_at
from l2m_gtsam.slam.options import DriftOptions, KeyPoseOptions
from l2m_gtsam.slam.pose_graph import PoseGraph, solve_pose_graph
from l2m_gtsam.studies.slam_array.odometry import slipping
from tests.drives.slam import rounds

SIGMA = np.repeat([0.002, 0.01], 3)  # of a registration, rad and m
SURE = 0.9999


def pose(trajectory: Trajectory, stamp: int) -> RigidTransform:
    at = interpolated(trajectory, np.array([stamp]))
    return RigidTransform(at.R[0], at.p[0])


def noisy(T: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    return perturbed(T, SIGMA * rng.normal(size=6))


def a_fix(truth: Trajectory, stamp: int, rng: np.random.Generator) -> PoseFix:
    return PoseFix(stamp, noisy(pose(truth, stamp), rng), np.diag(SIGMA**2))


def a_loop(truth: Trajectory, start: int, end: int, rng: np.random.Generator) -> LoopClosure:
    T = between(pose(truth, start), pose(truth, end))
    return LoopClosure(start, end, noisy(T, rng), np.diag(SIGMA**2))


def scanned(truth: Trajectory, odometry: Trajectory, seen: ScanEvidence) -> tuple[Drive, IntArray]:
    """Return a drive without readings, and the rows of its key poses."""
    rows = key_pose_rows(odometry, KeyPoseOptions(distance_m=0.5))
    rows = with_rows_at(rows, odometry, link_stamps(seen))
    no = np.empty(0, dtype=np.int64)
    none, rows_of_3 = np.empty(0), np.empty((0, 3))
    empty = KeyPoseReadings(no, no, np.empty((0, 3, 3)), rows_of_3, none, rows_of_3)
    sensors = KnownSensors((), np.empty((0, 3)), np.empty((0, 12)), none, none, np.empty((0, 15)))
    begin = StartPose(RigidTransform(truth.R[0], truth.p[0]), 1e-6 * np.eye(6))
    steps = odometry_steps(odometry, rows, DriftOptions())
    links = key_pose_links(seen, odometry, rows, DriftOptions())
    return Drive(odometry.stamp_ns[rows], steps, empty, begin, sensors, no, links), rows


def errors(found: PoseGraph, truth: Trajectory, rows: IntArray) -> FloatArray:
    """Return how far positions are off in metres, shape (K,)."""
    p = np.stack([each.translation() for each in found.poses])
    return np.asarray(np.linalg.norm(p - truth.p[rows], axis=1))


@given(st.integers(0, 2**32 - 1))
def test_links_say_of_key_poses_what_scans_say_of_theirs(seed: int) -> None:
    """Scans at any time, odometry without error: the links are the key poses themselves."""
    rng, truth = np.random.default_rng(seed), rounds(20)
    rows = key_pose_rows(truth, KeyPoseOptions(distance_m=0.5))
    stamps = rng.integers(truth.stamp_ns[0], truth.stamp_ns[-1], 3)
    first, second = sorted(stamps[:2].tolist())
    fix = PoseFix(int(stamps[2]), pose(truth, int(stamps[2])), np.eye(6))
    loop = LoopClosure(first, second, between(pose(truth, first), pose(truth, second)), np.eye(6))
    links = key_pose_links(ScanEvidence((fix,), (loop,)), truth, rows, DriftOptions())
    for origin, k, R, p in zip(links.origin, links.key_pose, links.R, links.p, strict=True):
        here = RigidTransform(truth.R[rows[k]], truth.p[rows[k]])
        there = RigidTransform(truth.R[rows[origin]], truth.p[rows[origin]])
        told = here if origin == MAP else between(there, here)
        # Interpolated positions lie on chords, and rotations on arcs: nothing but rounding is left.
        np.testing.assert_allclose(R, told.R, atol=1e-9)
        np.testing.assert_allclose(p, told.t, atol=1e-9)


def test_covariances_go_with_the_errors_that_they_are_of() -> None:
    """A loop, and the ways from its scans to their key poses, drawn with their errors."""
    rng, truth, drift = np.random.default_rng(1), rounds(20), DriftOptions()
    rows = key_pose_rows(truth, KeyPoseOptions(distance_m=1.5))
    first, second = (int(truth.stamp_ns[row] + 7_000_000) for row in (40, 340))
    T = between(pose(truth, first), pose(truth, second))
    link = key_pose_links(
        ScanEvidence(loops=(LoopClosure(first, second, T, np.diag(SIGMA**2)),)), truth, rows, drift
    )
    exact = RigidTransform(link.R[0], link.p[0])
    origin, key = (
        RigidTransform(truth.R[rows[k]], truth.p[rows[k]])
        for k in (link.origin[0], link.key_pose[0])
    )
    T_origin_first = between(origin, pose(truth, first))
    T_second_key = between(pose(truth, second), key)
    drawn = []
    for _ in range(4000):
        early, late = (
            perturbed(each, rng.multivariate_normal(np.zeros(6), drifts(each, drift)))
            for each in (T_origin_first, T_second_key)
        )
        drawn.append(difference(exact, compose(compose(early, noisy(T, rng)), late)))
    # 4,000 draws tell variances to 2.2 %; four times that along any direction.
    sampled, root = np.cov(np.array(drawn).T), np.linalg.cholesky(link.covariance[0])
    ratio = np.linalg.solve(root, np.linalg.solve(root, sampled).T)
    np.testing.assert_allclose(np.linalg.eigvalsh(ratio), 1.0, atol=0.12)


def drifts(T: RigidTransform, options: DriftOptions) -> FloatArray:
    return np.asarray(drift_covariance(T.R[None], T.t[None], options)[0])


def test_key_poses_stand_where_scans_were_taken() -> None:
    drive = rounds(20)
    rows = key_pose_rows(drive, KeyPoseOptions(distance_m=0.5))
    wanted = drive.stamp_ns[[33, 34, 200]] + np.array([1, -1, 0]) * 10_000_000
    assert set(with_rows_at(rows, drive, wanted)) == {*rows.tolist(), 33, 34, 200}


def test_wrong_loops_and_fixes_are_left_out() -> None:
    """Every third registration is of another place, by metres: the others hold the drive."""
    rng, truth = np.random.default_rng(2), rounds(60)
    odometry = slipping(truth, rng, share=0.02)
    stamps = truth.stamp_ns[100::110]
    fixes = [a_fix(truth, int(stamp), rng) for stamp in stamps]
    pairs = [(truth.stamp_ns[k], truth.stamp_ns[k + 600]) for k in range(0, 590, 60)]
    loops = [a_loop(truth, int(start), int(end), rng) for start, end in pairs]
    away = perturbed(RigidTransform(np.eye(3), np.zeros(3)), np.array([0, 0, 0.3, 2.0, -1.5, 0]))
    for k in range(0, len(fixes), 3):
        fixes[k] = replace(fixes[k], T_map_lidar=compose(fixes[k].T_map_lidar, away))
    for k in range(1, len(loops), 3):
        loops[k] = replace(loops[k], T_from_to=compose(loops[k].T_from_to, away))
    drive, rows = scanned(truth, odometry, ScanEvidence(tuple(fixes), tuple(loops)))
    found = solve_pose_graph(drive, SURE)
    right = [k % 3 != 0 for k in range(len(fixes))] + [k % 3 != 1 for k in range(len(loops))]
    np.testing.assert_array_equal(found.believed, right)
    alone = PoseGraph(drive.dead_reckoning(), found.believed)
    assert errors(alone, truth, rows).max() > 0.3
    # A fix every 5 s tells 1 cm; between two of them odometry goes 1.5 m to either, 2 % off.
    assert errors(found, truth, rows).max() < 0.06


def test_loops_alone_take_drift_out() -> None:
    rng, truth = np.random.default_rng(3), rounds(60)
    odometry = slipping(truth, rng, share=0.02)
    pairs = [(truth.stamp_ns[k], truth.stamp_ns[k + 520]) for k in range(0, 650, 30)]
    loops = tuple(a_loop(truth, int(start), int(end), rng) for start, end in pairs)
    drive, rows = scanned(truth, odometry, ScanEvidence(loops=loops))
    found = solve_pose_graph(drive, SURE)
    assert found.believed.all()
    alone = errors(PoseGraph(drive.dead_reckoning(), found.believed), truth, rows)
    assert np.mean(errors(found, truth, rows) ** 2) < 0.25 * np.mean(alone**2)


def test_without_scans_the_poses_are_those_of_odometry() -> None:
    truth = rounds(5)
    drive, rows = scanned(truth, truth, ScanEvidence())
    found = solve_pose_graph(drive, SURE)
    assert not len(found.believed)
    assert errors(found, truth, rows).max() < 1e-9


@pytest.mark.parametrize("apart", [0.1, 0.5])
def test_fixes_that_share_an_error_say_no_more_than_one(apart: float) -> None:
    """Along 50 m, scans without noise: as many independent fixes as the cloud's errors allow."""
    options = ScanLocalisationOptions(cloud_m=0.01, cloud_over_m=5.0)
    own = np.diag(np.repeat(1e-12, 6))
    places = [RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])) for x in np.arange(0, 50, 0.03)]
    fixes = tuple(PoseFix(k, T, own + options.of_cloud()) for k, T in enumerate(places))
    kept = spaced(fixes, apart, options)
    assert 0.7 * 50 / apart < len(kept) <= 50 / apart + 1
    information = sum(1 / each.covariance[3, 3] for each in kept) * options.cloud_m**2
    # Within 2.5 m of either end fewer are near; half a fix is lost where a window begins.
    assert information == pytest.approx(50 / options.cloud_over_m, rel=0.2)
