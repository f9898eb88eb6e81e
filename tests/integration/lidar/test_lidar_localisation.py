"""Scans on a map's cloud: poses, refusals, the start, and loops."""

from collections.abc import Generator
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import LidarMap, RigidTransform, Trajectory
from l2m_gtsam.errors import LidarError
from l2m_gtsam.geometry import between, difference, perturbed
from l2m_gtsam.lidar import loop_closures
from l2m_gtsam.lidar.loop_closures import LoopOptions, closing_loop, find_loop_closures
from l2m_gtsam.lidar.odometry import ScanOdometryOptions, ScanStep, follow
from l2m_gtsam.lidar.registration import PoseEstimate, Refusal, unseen_covariance
from l2m_gtsam.lidar.scan_localisation import (
    ScanLocalisationOptions,
    ScanSearchOptions,
    find_start,
    localise_scans,
)
from l2m_gtsam.lidar.surface import Surface, smoothed
from l2m_gtsam.records.scans import LoopClosure
from l2m_gtsam.storage.cloud import thinned_cloud
from tests.worlds.lidar_rooms import ROOM, Room, round_trip, rows, scans, straight, swept

MAPPING = rows(round_trip(130), range(0, 130, 8))
DRIVE = rows(round_trip(150), range(1, 150, 6))  # once around the circle of 9.4 m and on
OPTIONS = ScanLocalisationOptions()
# Nothing of it but the floor and two walls can fit at a time.
OTHER = Room(((-5.0, -8.0, 0.0), (4.0, 7.0, 5.0)))
QUICK = ScanSearchOptions(tried=6)


def pose(trajectory: Trajectory, k: int) -> RigidTransform:
    return RigidTransform(trajectory.R[k], trajectory.p[k])


def unsure(T: RigidTransform) -> PoseEstimate:
    """Return a start of which little is known."""
    return PoseEstimate(T, unseen_covariance(OPTIONS.registration))


def cloud_of(room: Room) -> Surface:
    found = scans(room, MAPPING, np.random.default_rng(1))
    points = [scan.points @ MAPPING.R[k].T + MAPPING.p[k] for k, scan in enumerate(found)]
    return Surface(smoothed(thinned_cloud(np.concatenate(points), 0.1)))


@pytest.fixture(scope="module")
def cloud() -> Surface:
    return cloud_of(ROOM)


@pytest.fixture(scope="module")
def steps() -> list[ScanStep]:
    return list(follow(scans(ROOM, DRIVE, np.random.default_rng(2)), ScanOdometryOptions()))


def test_a_drive_on_a_cloud(cloud: Surface, steps: list[ScanStep]) -> None:
    start = perturbed(pose(DRIVE, 0), np.array([0, 0, 0.1, 0.3, 0.2, -0.1]))
    found = localise_scans(steps, cloud, unsure(start), OPTIONS, "hall")
    assert (found.scans, found.refused) == (len(DRIVE), {})
    assert found.trajectory.frame == "hall"
    np.testing.assert_array_equal(found.trajectory.stamp_ns, DRIVE.stamp_ns)
    # As single scans are: a millimetre is five times the errors' rms.
    np.testing.assert_allclose(found.trajectory.p, DRIVE.p, rtol=0, atol=2e-3)
    assert found.trajectory.covariance is not None
    nees = [[], []]  # type: list[list[float]]
    for k, fix in enumerate(found.fixes):
        by_scan = difference(fix.T_map_lidar, pose(DRIVE, k))
        together = difference(pose(found.trajectory, k), pose(DRIVE, k))
        of_cloud = OPTIONS.of_cloud()
        for which, (error, covariance) in enumerate(
            [(by_scan, fix.covariance), (together, found.trajectory.covariance[k])]
        ):
            nees[which].append(float(error @ np.linalg.solve(covariance - of_cloud, error)))
    # Without the share of the cloud; the floor of a millimetre is larger than the errors.
    assert np.mean(nees[0]) < 6.0
    assert np.mean(nees[1]) < 6.0


def test_a_start_elsewhere_is_refused_in_one_line(cloud: Surface, steps: list[ScanStep]) -> None:
    start = RigidTransform(np.eye(3), np.array([3.8, -4.0, 1.0]))
    with pytest.raises(LidarError, match=r"does not fit the map's cloud at \(3.8, -4, 1\) m") as e:
        localise_scans(steps[:1], cloud, unsure(start), OPTIONS)
    assert "lidar.start" in str(e.value)
    assert "\n" not in str(e.value)


def test_scans_of_another_room_are_counted_and_left_out(
    cloud: Surface, steps: list[ScanStep]
) -> None:
    """Somebody stands around the lidar for a second; odometry bridges it."""
    odd = list(
        follow(scans(OTHER, rows(DRIVE, [5]), np.random.default_rng(0)), ScanOdometryOptions())
    )
    mixed = [
        replace(step, surface=odd[0].surface) if 5 <= k < 8 else step
        for k, step in enumerate(steps[:14])
    ]
    found = localise_scans(mixed, cloud, unsure(pose(DRIVE, 0)), OPTIONS)
    assert found.refused == {Refusal.ELSEWHERE: 3}
    kept = [k for k in range(len(mixed)) if not 5 <= k < 8]
    np.testing.assert_array_equal(found.trajectory.stamp_ns, DRIVE.stamp_ns[kept])
    np.testing.assert_allclose(found.trajectory.p, DRIVE.p[kept], rtol=0, atol=2e-3)


def test_swept_scans_are_where_they_were_at_their_stamps(cloud: Surface) -> None:
    """At 1 m/s a turn of 0.1 s would move them by 5 cm."""
    true, twist = straight(6, speed=1.0), np.array([0, 0, 0, 1.0, 0, 0])
    steps = follow(swept(ROOM, true, twist, 0.1), ScanOdometryOptions())
    found = localise_scans(steps, cloud, unsure(pose(true, 0)), OPTIONS)
    error = np.linalg.norm(found.trajectory.p - true.p, axis=1)
    # The speed is that of the step before, wrong by centimetres per second.
    assert np.all(error < 0.006)


def test_no_scans() -> None:
    with pytest.raises(LidarError, match="no scan has points enough"):
        localise_scans([], Surface(np.zeros((0, 3))), unsure(pose(DRIVE, 0)), OPTIONS)


def mapped(trajectory: Trajectory) -> LidarMap:
    """The poses of a mapping drive; the cloud is given as a surface."""
    return LidarMap(np.zeros((0, 3)), trajectory.R, trajectory.p)


def test_the_start_is_found_along_the_mapping_drive(cloud: Surface, steps: list[ScanStep]) -> None:
    """The mapping drive passed 0.4 m beside, heading 150 degrees elsewhere."""
    turn = Rotation.from_euler("Z", 150, degrees=True).as_matrix()
    places = replace(rows(MAPPING, range(4, 9)), R=turn @ MAPPING.R[4:9])
    beside = replace(places, p=places.p + np.array([0.3, -0.3, 0.0]))
    found = find_start(steps[8].surface, cloud, mapped(beside), QUICK, OPTIONS.registration)
    np.testing.assert_allclose(found.t, DRIVE.p[8], rtol=0, atol=2e-3)


def test_an_ambiguous_start_is_refused() -> None:
    """An empty room looks the same turned by half a turn."""
    hall = Room(((-5.0, -3.0, 0.0), (5.0, 3.0, 3.0)))
    steps = list(
        follow(scans(hall, rows(DRIVE, [3]), np.random.default_rng(2)), ScanOdometryOptions())
    )
    with pytest.raises(LidarError, match=r"fits at several places, .* and .*; set `lidar.st"):
        find_start(
            steps[0].surface,
            cloud_of(hall),
            mapped(rows(MAPPING, range(0, 17, 4))),
            QUICK,
            OPTIONS.registration,
        )


def test_another_building_is_told(cloud: Surface) -> None:
    steps = list(
        follow(scans(OTHER, rows(DRIVE, [3]), np.random.default_rng(2)), ScanOdometryOptions())
    )
    with pytest.raises(LidarError, match="fits nowhere along the mapping drives"):
        find_start(
            steps[0].surface,
            cloud,
            mapped(rows(MAPPING, range(0, 17, 4))),
            QUICK,
            OPTIONS.registration,
        )


def test_loops_are_closed(steps: list[ScanStep]) -> None:
    found = find_loop_closures(steps, LoopOptions(least_way_m=8.0))
    assert len(found) >= 1
    row = {int(stamp): k for k, stamp in enumerate(DRIVE.stamp_ns)}
    for loop in found:
        assert loop.to_ns > loop.from_ns
        true = between(pose(DRIVE, row[loop.from_ns]), pose(DRIVE, row[loop.to_ns]))
        error = difference(loop.T_from_to, true)
        assert np.linalg.norm(error[3:]) < 0.004  # two scans of 10 mm noise
        assert error @ np.linalg.solve(loop.covariance, error) < 17


def test_wrong_loops_are_refused(steps: list[ScanStep], monkeypatch: pytest.MonkeyPatch) -> None:
    """Odometry believes to be back where it began; the scans are of another room."""
    compared = []

    def noted(*scans: Any) -> Generator[None, None, LoopClosure | Refusal]:
        compared.append((yield from closing_loop(*scans)))
        return compared[-1]

    monkeypatch.setattr(loop_closures, "closing_loop", noted)
    odd = follow(
        scans(OTHER, rows(DRIVE, range(8)), np.random.default_rng(3)), ScanOdometryOptions()
    )
    later = 60_000_000_000
    moved = [replace(each, stamp_ns=each.stamp_ns + later) for each in odd]
    found = find_loop_closures(chain(steps[:20], moved), LoopOptions(least_way_m=4.0, search_m=4.0))
    wrong = [each for each in found if each.to_ns - each.from_ns > later / 2]
    assert wrong == []
    assert compared.count(Refusal.ELSEWHERE) >= 2
