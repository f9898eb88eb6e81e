"""Scans of worlds whose every range has a formula."""

import sys
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory, joined_rows
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.simulate.lidar import RayCaster, SpinningLidarOptions
from l2m_gtsam.simulate.solids import Solids
from tests.worlds.ray_cast import scans, snapshots

ROOM = np.array([8.0, 6.0, 3.0])
START_NS = 1_700_000_000_000_000_000
EXACT = SpinningLidarOptions(noise=0.0, nearest=0.0, columns=360)
# Surfaces are met in double precision; rays start at coordinates below 10 m.
ROUNDING_M = 1e-12


def room() -> Solids:
    return Solids.spanned(np.zeros(3), ROOM)


def still(R: FloatArray, p: FloatArray) -> Trajectory:
    """One pose, and the same a second later."""
    stamps = START_NS + np.array([0, 1_000_000_000])
    return Trajectory(stamps, np.stack([R, R]), np.stack([p, p]), "map", "lidar")


def to_walls(p: FloatArray, directions: FloatArray) -> FloatArray:
    """Way from within the room to its walls: the least of the six planes ahead."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.max([-p / directions, (ROOM - p) / directions], axis=0).min(axis=1))


@pytest.mark.parametrize("seed", range(3))
def test_in_an_empty_room_every_range_is_that_of_six_planes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, p = Rotation.random(rng=rng).as_matrix(), rng.uniform(0.2, 0.8, 3) * ROOM
    scan = snapshots(room(), EXACT, still(R, p))[0]
    rays = EXACT.directions().reshape(-1, 3)
    assert len(scan) == len(rays)  # no ray slips through an edge
    expected = to_walls(p, rays @ R.T)[:, None] * rays
    np.testing.assert_allclose(scan.points, expected, rtol=0, atol=ROUNDING_M)


def test_what_stands_in_front_hides_what_is_behind() -> None:
    """A turned post in the room: the shadow on the walls is the one that geometry gives."""
    half, centre, yaw = np.array([0.2, 0.3]), np.array([5.0, 3.0]), 0.4
    R_map_post = Rotation.from_euler("Z", yaw).as_matrix()
    post = Solids(np.array([[*(2 * half), 3.0]]), np.array([[*centre, 1.5]]), R_map_post[None])
    p = np.array([2.0, 2.0, 1.0])
    scan = snapshots(joined_rows([room(), post]), EXACT, still(np.eye(3), p))[0]
    rays = EXACT.directions().reshape(-1, 3)
    # Slabs in the post's own plane: entered when the last of both is.
    start, ahead = (p[:2] - centre) @ R_map_post[:2, :2], rays[:, :2] @ R_map_post[:2, :2]
    near, far = np.sort([(-half - start) / ahead, (half - start) / ahead], axis=0)
    enter, leave = near.max(axis=1), far.min(axis=1)
    wall = to_walls(p, rays)
    met = (enter < leave) & (enter > 0) & (enter < wall)
    assert met.sum() > 100
    expected = np.where(met, enter, wall)
    np.testing.assert_allclose(
        np.linalg.norm(scan.points, axis=1), expected, rtol=0, atol=ROUNDING_M
    )


def test_ranges_are_noisy_along_the_ray_as_stated_and_cut_off() -> None:
    options = SpinningLidarOptions(noise=0.02, nearest=1.5, furthest=4.0)
    p = np.array([4.0, 3.0, 1.0])
    scan = snapshots(room(), options, still(np.eye(3), p))[0]
    measured = np.linalg.norm(scan.points, axis=1)
    assert (measured.min() >= 1.5) & (measured.max() <= 4.0)
    exact = to_walls(p, scan.points / measured[:, None])
    inner = (exact > 1.6) & (exact < 3.9)  # five sigmas from where noise is cut off
    error = (measured - exact)[inner]
    # Five standard deviations of a mean and of a standard deviation.
    assert abs(error.mean()) < 5 * 0.02 / np.sqrt(len(error))
    assert error.std() == pytest.approx(0.02, rel=5 / np.sqrt(2 * len(error)))


def test_a_seed_gives_the_same_scans_in_any_order_and_another_gives_others() -> None:
    poses = still(np.eye(3), ROOM / 2)
    first, again = (snapshots(room(), SpinningLidarOptions(), poses, seed=4) for _ in range(2))
    backwards = [again[1], again[0]][::-1]
    for ours, theirs in zip(first, backwards, strict=True):
        assert ours.points.tobytes() == theirs.points.tobytes()
    assert not np.array_equal(first[0].points, first[1].points)
    other = snapshots(room(), SpinningLidarOptions(), poses, seed=5)
    assert not np.array_equal(first[0].points, other[0].points)


def driving(stamp_ns: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Trajectory:
    """2 m/s along x while turning left at 1 rad/s."""
    t = (stamp_ns - START_NS) * 1e-9
    R = Rotation.from_rotvec(np.outer(t, [0.0, 0.0, 1.0])).as_matrix()
    p = np.column_stack([1.0 + 2.0 * t, np.full_like(t, 3.0), np.full_like(t, 1.0)])
    return Trajectory(stamp_ns, R, p, "map", "lidar")


def placed(scan: Scan) -> FloatArray:
    """Points in the map, each by the pose at its own time."""
    assert scan.time_s is not None
    poses = driving(scan.stamp_ns + np.round(scan.time_s * 1e9).astype(np.int64))
    return np.asarray(np.einsum("nij,nj->ni", poses.R, scan.points) + poses.p)


def test_a_sweep_is_distorted_by_motion_and_made_good_by_the_points_times() -> None:
    options = EXACT.model_copy(update={"sweep": 0.1})
    scan = scans(room(), options, driving, np.array([START_NS]))[0]
    assert scan.time_s is not None
    assert np.all(np.diff(scan.time_s) >= 0)
    assert 0 == scan.time_s[0] < scan.time_s[-1] < 0.1

    def off(points: FloatArray) -> FloatArray:
        return np.asarray(np.minimum(np.abs(points), np.abs(points - ROOM)).min(axis=1))

    # A time of some 1e-2 s out of nanoseconds since 1970: rounded to 1 ns, 2 nm.
    assert off(placed(scan)).max() < 1e-8
    raw = driving(scan.stamp_ns + np.zeros(1, dtype=np.int64))
    assert off(scan.points @ raw.R[0].T + raw.p[0]).max() > 0.1
    snapshot = scans(room(), EXACT, driving, np.array([START_NS]))[0]
    assert snapshot.time_s is None


def test_a_ray_that_meets_nothing_goes_on_for_ever() -> None:
    caster = RayCaster(room())
    outside = np.array([[-1.0, 3.0, 1.0], [-1.0, 3.0, 1.0]])
    found = caster.ranges(outside, np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(found, [np.inf, 1.0], rtol=0, atol=ROUNDING_M)


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"lowest": 5.0, "highest": -5.0}, "`lowest` must not be above"),
        ({"nearest": 5.0, "furthest": 5.0}, "`nearest` must be less"),
        ({"sweep": 0.2}, r"`sweep` must end before the next turn, 0\.1 s at most"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    wrong: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ValidationError, match=complaint):
        SpinningLidarOptions(**wrong)


def test_without_the_libraries_one_line_says_how_to_get_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ConfigError, match=r"pip install 'l2m-gtsam\[lidar\]'"):
        RayCaster(room())
