"""Odometry from scans: a drive around a room, a corridor, swept and missing scans."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import between, difference
from l2m_gtsam.lidar.odometry import ScanOdometryOptions, ScanStep, accumulated, follow, odometry
from l2m_gtsam.records.scans import Scan, taken_at_once
from tests.worlds.lidar_rooms import CORRIDOR, ROOM, Room, round_trip, rows, scans, straight, swept

OPTIONS = ScanOdometryOptions()
EMPTY = Room(ROOM.walls)
QUICK = rows(round_trip(60), range(0, 60, 2))  # five scans per second, 5 m


def pose(trajectory: Trajectory, k: int) -> RigidTransform:
    return RigidTransform(trajectory.R[k], trajectory.p[k])


def error(found: Trajectory, true: Trajectory, k: int, row: int | None = None) -> FloatArray:
    """Right perturbation from a found pose to the true one, both from the first."""
    row = k if row is None else row
    return difference(pose(found, k), between(pose(true, 0), pose(true, row)))


def nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


@pytest.fixture(scope="module")
def round_steps() -> list[ScanStep]:
    return list(follow(scans(ROOM, QUICK, np.random.default_rng(2)), OPTIONS))


def test_a_drive_around_a_room(round_steps: list[ScanStep]) -> None:
    found = accumulated(round_steps)
    assert len(found) == len(QUICK)
    assert (found.frame, found.child_frame) == ("odom", "lidar")
    np.testing.assert_array_equal(found.stamp_ns, QUICK.stamp_ns)
    assert all(step.believed for step in round_steps)
    last = error(found, QUICK, len(found) - 1)
    # 5 m in seven key scans, each found to half a millimetre.
    assert np.linalg.norm(last[3:]) < 0.006
    assert np.linalg.norm(last[:3]) < np.deg2rad(0.1)


def test_covariances_hold_and_accumulate(round_steps: list[ScanStep]) -> None:
    """NEES, 6 is honest: of single steps, and of the poses, whose steps partly undo each other."""
    found, steps, poses = accumulated(round_steps), [], []
    for k in range(1, len(found)):
        true = between(pose(QUICK, k - 1), pose(QUICK, k))
        steps.append(nees(difference(round_steps[k].step, true), round_steps[k].covariance))
        poses.append(nees(error(found, QUICK, k), found.covariance[k]))  # type: ignore[index]  # stated
    # The floor of 1 mm and 0.01 degrees is larger than the errors here: less than honest.
    assert np.mean(steps) < 8.0
    assert np.mean(poses) < 8.0
    assert found.covariance is not None
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[:, 3:]
    assert np.all(np.diff(np.linalg.norm(sigma, axis=1)) > 0)
    assert sigma[-1].max() < 0.02  # large enough must not mean meaningless


def test_in_a_corridor_the_covariance_opens_along_it() -> None:
    """Rings of points move with the lidar: it seems to stand still, and knows not to know."""
    true = rows(straight(20), range(0, 20, 2))
    found = odometry(scans(CORRIDOR, true, np.random.default_rng(0)), OPTIONS)
    assert found.covariance is not None
    last = error(found, true, len(found) - 1)
    sigma = np.sqrt(np.diag(found.covariance[-1]))
    assert abs(last[3]) > 1.0  # of 1.8 m: odometry is wrong here,
    assert abs(last[3]) < 2 * sigma[3]  # and says so,
    assert np.all(np.abs(last[4:]) < 0.005)  # but not across, nor in heading
    assert np.all(sigma[4:] < 0.03)
    assert abs(last[2]) < np.deg2rad(0.1)


def test_a_swept_scan_is_brought_to_its_stamp() -> None:
    """Against a snapshot: every point lies on a wall of the room again."""
    twist = np.array([0.0, 0.0, 0.8, 1.5, 0.0, 0.0])
    one = rows(round_trip(2), [0])
    (scan,) = swept(EMPTY, one, twist, 0.1)
    still = taken_at_once(scan, twist) @ one.R[0].T + one.p[0]
    raw = scan.points @ one.R[0].T + one.p[0]
    low, high = np.array(ROOM.walls)

    def off(points: FloatArray) -> FloatArray:
        away = np.abs(np.stack([points - low, points - high]))
        return np.asarray(away.min(axis=(0, 2)))

    assert np.max(off(raw)) > 0.05
    assert np.max(off(still)) < 1e-9


def test_scans_without_points_and_missing_ones() -> None:
    """Two seconds without a scan: what comes after fits the key scan again."""
    true = rows(round_trip(60), [*range(0, 20, 2), *range(30, 44, 2)])
    given = list(scans(ROOM, true, np.random.default_rng(3)))
    given[4] = replace(given[4], points=given[4].points[:5])
    found = odometry(given, OPTIONS)
    kept = [k for k in range(len(true)) if k != 4]
    np.testing.assert_array_equal(found.stamp_ns, true.stamp_ns[kept])
    assert np.linalg.norm(error(found, true, len(found) - 1, kept[-1])[3:]) < 0.01


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_pause_in_which_the_motion_changed(share: float) -> None:
    """Four seconds without a scan, in which the lidar stands still, or is half as fast."""
    true = rows(round_trip(100), [*range(16, 30, 2), *range(30 + round(40 * share), 60, 2)])
    later = np.where(np.arange(len(true)) < 7, 0, round(4e9 * (1 - share)))
    true = replace(true, stamp_ns=true.stamp_ns + later)
    steps = list(follow(scans(ROOM, true, np.random.default_rng(3)), OPTIONS))
    last = len(true) - 1
    covariance = accumulated(steps).covariance
    assert covariance is not None
    off = error(accumulated(steps), true, last)
    if share == 0.0:
        assert all(step.believed for step in steps)
        assert np.linalg.norm(off[3:]) < 0.01
    assert nees(off, covariance[last]) < 12.0


def test_no_scan_no_pose() -> None:
    assert len(odometry([], OPTIONS)) == 0
    empty = Scan(0, np.zeros((0, 3)))
    assert len(odometry([empty], OPTIONS)) == 0


def test_the_same_scans_give_the_same_poses() -> None:
    true = rows(round_trip(60), range(0, 8, 2))
    given = list(scans(ROOM, true, np.random.default_rng(5)))
    one, other = odometry(given, OPTIONS), odometry(given, OPTIONS)
    np.testing.assert_array_equal(one.p, other.p)
