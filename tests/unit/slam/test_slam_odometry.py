"""Key poses, what odometry says between them, and readings that hang on them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Readings, RigidTransform, Trajectory
from l2m_gtsam.geometry import moved
from l2m_gtsam.slam.drift import PLANE, plane_hints
from l2m_gtsam.slam.key_pose_readings import (
    evenly_spread,
    key_pose_readings,
    mean_readings,
    thinned_readings,
)
from l2m_gtsam.slam.odometry import key_pose_rows, odometry_steps
from l2m_gtsam.slam.options import DriftOptions, KeyPoseOptions
from l2m_gtsam.slam.pose_graph import stated_information_root
from tests.drives.slam import rounds


def straight(metres: float, step: float = 0.05) -> Trajectory:
    """Return a way along x."""
    x = np.arange(0, metres + step / 2, step)
    p = np.column_stack([x, np.zeros((len(x), 2))])
    stamps = np.arange(len(x)) * 50_000_000
    return Trajectory(stamps, np.tile(np.eye(3), (len(x), 1, 1)), p, "map", "lidar")


@given(st.floats(0.1, 1.0), st.floats(3, 30))
def test_key_poses_are_no_further_apart_than_asked(distance: float, angle: float) -> None:
    """But for one odometry step of 3 cm and 2 degrees, and the last pose, which is always one."""
    drive = rounds(20)
    rows = key_pose_rows(drive, KeyPoseOptions(distance_m=distance, angle_deg=angle))
    assert rows[0] == 0
    assert rows[-1] == len(drive) - 1
    way = np.linalg.norm(np.diff(drive.p[rows], axis=0), axis=1)
    R_back = drive.R[rows[:-1]].transpose(0, 2, 1)
    turn = np.rad2deg(Rotation.from_matrix(R_back @ drive.R[rows[1:]]).magnitude())
    assert way.max() < distance + 0.05
    assert turn.max() < angle + 2.5
    assert np.all((way[:-1] >= distance) | (turn[:-1] >= angle - 1e-6))


def test_a_parked_vehicle_makes_no_key_poses() -> None:
    """Poses at rest that wander by 5 mm and 0.1 degrees."""
    rng, n = np.random.default_rng(1), 500
    R = Rotation.from_rotvec(rng.normal(0, 0.002, (n, 3))).as_matrix()
    at_rest = Trajectory(np.arange(n), R, rng.normal(0, 0.005, (n, 3)), "map", "lidar")
    np.testing.assert_array_equal(key_pose_rows(at_rest, KeyPoseOptions()), [0, n - 1])


@pytest.mark.parametrize("spacing", [0.1, 0.5, 2.0])
def test_drift_is_its_share_after_the_reference_way_however_it_is_cut(spacing: float) -> None:
    """1 % of 10 m is 10 cm, from key poses of any spacing: what each may add is 2 %."""
    drive, options = straight(10.0), DriftOptions(over_m=10.0)
    rows = key_pose_rows(drive, KeyPoseOptions(distance_m=spacing - 1e-9))
    steps = odometry_steps(drive, rows, options)
    assert not steps.stated
    total = np.sqrt(steps.covariance[:, 3:, 3:].sum(axis=0))
    np.testing.assert_allclose(np.diag(total), 0.1, rtol=0.02)
    turned = np.rad2deg(np.sqrt(steps.covariance[:, :3, :3].sum(axis=0)))
    # 0.05 deg/m over 10 m, and 0.02 deg of every step beside.
    expected = np.hypot(0.5, 0.02 * np.sqrt(len(steps)))
    np.testing.assert_allclose(np.diag(turned), expected, rtol=1e-6)


@given(st.integers(0, 1000), st.floats(0, 1), st.floats(0, 1))
def test_what_is_level_is_so_about_the_vertical(
    seed: int, of_height: float, of_tilt: float
) -> None:
    """However the lidar is mounted: along and about the vertical, and across it.

    Variances are those of all axes alike, times the squares of the ratios.
    """
    drive, alike = rounds(5), DriftOptions(least_m=1e-6, least_deg=1e-5)
    mount = Rotation.random(random_state=seed).as_matrix()
    tilted, rows = replace(drive, R=drive.R @ mount), np.arange(0, len(drive), 5)
    plain = odometry_steps(tilted, rows, alike).covariance
    ratios = {"height_share": 0.01 * of_height, "tilt_deg_per_m": 0.05 * of_tilt}
    level = odometry_steps(tilted, rows, alike.model_copy(update=ratios)).covariance
    ratio = np.array([of_tilt, of_tilt, 1.0, 1.0, 1.0, of_height])
    axes = np.zeros((len(rows) - 1, 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = tilted.R[rows[1:]]
    found, expected = (axes @ each @ axes.transpose(0, 2, 1) for each in (level, plain))
    # The least that a step errs is a millionth of all, in variance less.
    np.testing.assert_allclose(found, expected * ratio[:, None] * ratio, atol=1e-9)


@given(st.integers(0, 1000), st.floats(0, 0.05))
def test_a_steady_drift_of_a_level_vehicle_walks_level(seed: int, height_share: float) -> None:
    """On average over the drive; here along x, whatever way the lidar looks."""
    drive, share, over = straight(10.0), 0.02, 20.0
    mount = Rotation.random(random_state=seed).as_matrix()
    drive = replace(drive, R=drive.R @ mount)
    options = DriftOptions(position_share=0.01, steady=share, height_share=height_share)
    steps = odometry_steps(drive, np.arange(0, len(drive), 4), options)
    more = (steps.as_walk(over).covariance - steps.covariance)[:, 3:, 3:].sum(axis=0)
    of_height = height_share / 0.01
    expected = share**2 * over * 10.0 * np.array([1.0, 1.0, of_height**2])
    np.testing.assert_allclose(mount @ more @ mount.T, np.diag(expected), atol=1e-12)


def test_odometry_of_wheels_is_known_by_its_plane() -> None:
    """However the lidar is mounted; a millimetre of height is none of wheels' odometry."""
    drive, mount = straight(10.0), Rotation.from_euler("xyz", [0.2, -0.1, 0.4]).as_matrix()
    flat = replace(drive, R=drive.R @ mount)
    assert plane_hints(flat, DriftOptions(), is_stated=False) == (PLANE,)
    assert plane_hints(flat, DriftOptions(), is_stated=True) == ()
    assert plane_hints(flat, DriftOptions(height_share=0.0), is_stated=False) == ()
    uneven = flat.p + np.random.default_rng(0).normal(0, 1e-3, flat.p.shape) * [0, 0, 1]
    assert plane_hints(replace(flat, p=uneven), DriftOptions(), is_stated=False) == ()
    tilting = flat.R @ Rotation.from_rotvec([1e-3, 0, 0]).as_matrix()
    tilted = replace(flat, R=np.vstack([flat.R[:9], tilting[9:]]))
    assert plane_hints(tilted, DriftOptions(), is_stated=False) == ()


def accumulated(drive: Trajectory, Q: FloatArray) -> Trajectory:
    """Return a drive whose covariances grow by Q at every step."""
    P = [1e-6 * np.eye(6)]
    for k in range(1, len(drive)):
        R = drive.R[k - 1].T @ drive.R[k]
        step = RigidTransform(R, drive.R[k - 1].T @ (drive.p[k] - drive.p[k - 1]))
        P.append(moved(P[-1][None], step)[0] + Q)
    return replace(drive, covariance=np.stack(P))


def test_covariances_that_grow_are_those_of_the_steps() -> None:
    """What was added at each step comes back, beside the least that every step has."""
    Q = np.diag([1e-6, 2e-6, 3e-6, 1e-5, 2e-5, 3e-5])
    drive, options = accumulated(rounds(5), Q), DriftOptions()
    steps = odometry_steps(drive, np.arange(len(drive)), options)
    assert steps.stated
    least = np.repeat([np.deg2rad(options.least_deg), options.least_m], 3)
    expected = Q + np.diag(least**2)
    # Differences of sums a hundred times as large.
    np.testing.assert_allclose(steps.covariance, np.tile(expected, (len(steps), 1, 1)), atol=1e-11)


def test_covariances_that_do_not_grow_say_nothing_of_steps() -> None:
    drive = rounds(5)
    constant = replace(drive, covariance=np.tile(1e-4 * np.eye(6), (len(drive), 1, 1)))
    rows = key_pose_rows(drive, KeyPoseOptions())
    steps = odometry_steps(constant, rows, DriftOptions())
    assert not steps.stated
    plain = odometry_steps(drive, rows, DriftOptions())
    np.testing.assert_array_equal(steps.covariance, plain.covariance)


def test_readings_hang_where_they_were() -> None:
    """Placed on the key poses of odometry itself, readings have the poses that they came with."""
    drive = rounds(10)
    rows = key_pose_rows(drive, KeyPoseOptions())
    n = len(drive)
    sensor = np.repeat(np.arange(2), n)
    twice = np.concatenate([np.arange(n)] * 2)
    field = np.arange(6.0 * n).reshape(-1, 3)
    readings = Readings(
        ("a", "b"), sensor, drive.stamp_ns[twice], drive.R[twice], drive.p[twice], field
    )
    kept = thinned_readings(readings, drive, rows, most=1000)
    hung = key_pose_readings(kept, drive, rows)
    assert np.all(np.diff(hung.key_pose) >= 0)
    placed = hung.placed(drive.R[rows][hung.key_pose], drive.p[rows][hung.key_pose])
    back = np.argsort(placed.field[:, 0])
    np.testing.assert_allclose(placed.p_map_lidar[back], readings.p_map_lidar, atol=1e-12)
    np.testing.assert_allclose(placed.R_map_lidar[back], readings.R_map_lidar, atol=1e-12)
    # Each lies between its key pose and the next, and the more way lies behind it the later it is.
    before, after = (drive.stamp_ns[rows][hung.key_pose[back] + each] for each in (0, 1))
    assert np.all((before <= readings.stamp_ns) & (readings.stamp_ns <= after))
    assert np.all((before < readings.stamp_ns) | (readings.stamp_ns == drive.stamp_ns[0]))
    fraction, late = hung.fraction[back], (readings.stamp_ns - before) / (after - before)
    # Along a rosette at a speed that hardly varies over 0.2 m.
    np.testing.assert_allclose(fraction, late, atol=0.05)
    assert np.all(fraction[readings.stamp_ns == after] == 1.0)


@pytest.mark.parametrize("most", [1, 3, 1000])
def test_means_are_those_of_readings_between_key_poses(most: int) -> None:
    """Each reading is in one of them, and their noise falls with the root of how many they are."""
    drive = rounds(20)
    rows = key_pose_rows(drive, KeyPoseOptions(distance_m=0.3))
    n, rng = len(drive), np.random.default_rng(1)
    sensor, twice = np.repeat(np.arange(2), n), np.concatenate([np.arange(n)] * 2)
    read = Readings(
        ("a", "b"),
        sensor,
        drive.stamp_ns[twice],
        drive.R[twice],
        drive.p[twice],
        rng.normal(size=(2 * n, 3)),
    )
    kept = mean_readings(read, drive, rows, most)
    key = np.maximum(np.searchsorted(drive.stamp_ns[rows], read.stamp_ns) - 1, 0)
    groups = [
        np.flatnonzero((key == k) & (sensor == of)) for k in range(len(rows) - 1) for of in range(2)
    ]
    assert len(kept) == sum(min(most, len(own)) for own in groups)
    if most == 1:
        expected = np.stack([read.field[own].mean(axis=0) for own in groups])
        np.testing.assert_allclose(kept.field, expected, atol=1e-12)
        expected = np.stack([read.p_map_lidar[own].mean(axis=0) for own in groups])
        np.testing.assert_allclose(kept.p_map_lidar, expected, atol=1e-12)
    assert np.linalg.det(kept.R_map_lidar) == pytest.approx(1.0)
    many = len(read) / len(kept)
    # Of some 130 numbers a standard deviation is known to 6 %.
    assert kept.field.std() == pytest.approx(1 / np.sqrt(many), rel=0.2)
    hung = key_pose_readings(kept, drive, rows)
    assert np.all(np.diff(hung.key_pose) >= 0)


def test_means_of_single_readings_are_these() -> None:
    drive = rounds(5)
    rows = np.arange(len(drive))
    at = rows[1:]
    read = Readings(
        ("a",),
        np.zeros(len(at), dtype=np.int64),
        drive.stamp_ns[at],
        drive.R[at],
        drive.p[at],
        np.random.default_rng(2).normal(size=(len(at), 3)),
    )
    means, picked = (each(read, drive, rows, 1) for each in (mean_readings, thinned_readings))
    np.testing.assert_array_equal(means.field, picked.field)
    np.testing.assert_array_equal(means.stamp_ns, picked.stamp_ns)
    np.testing.assert_allclose(means.R_map_lidar, picked.R_map_lidar, atol=1e-12)


def test_what_is_read_at_rest_is_behind_no_more_of_the_way() -> None:
    """A vehicle that stands for ten seconds within a step, then turns on the spot."""
    at = np.array([0.0, 1.0, 11.0, 12.0, 13.0])
    x = np.array([0.0, 0.1, 0.1, 0.2, 0.2])
    yaw = np.array([0.0, 0.0, 0.0, 0.0, 0.2])
    R = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    drive = Trajectory(
        (1e9 * at).astype(np.int64), R, np.outer(x, [1.0, 0.0, 0.0]), "odom", "lidar"
    )
    stamps = (1e9 * np.array([0.0, 1.0, 6.0, 11.0, 12.0, 12.5, 13.0])).astype(np.int64)
    n = len(stamps)
    still = np.tile(np.eye(3), (n, 1, 1))
    readings = Readings(
        ("a",), np.zeros(n, np.int64), stamps, still, np.zeros((n, 3)), np.zeros((n, 3))
    )
    hung = key_pose_readings(readings, drive, np.array([0, 4]))
    # 0.2 m of way and 0.2 rad of turning at an arm of a metre; creeping for 13 s is 13 um.
    np.testing.assert_allclose(hung.fraction, [0, 0.25, 0.25, 0.25, 0.5, 0.75, 1], atol=1e-4)


@given(st.lists(st.integers(0, 3), min_size=1, max_size=60), st.integers(1, 5))
def test_groups_are_thinned_evenly(labels: list[int], most: int) -> None:
    groups = np.array(labels)[:, None]
    kept = evenly_spread(groups, most)
    assert np.all(np.diff(groups[kept, 0]) >= 0)
    for label in set(labels):
        members, own = np.flatnonzero(groups[:, 0] == label), kept[groups[kept, 0] == label]
        assert len(own) == min(most, len(members))
        assert len(np.unique(own)) == len(own)
        assert own[0] == members[0]


@given(st.integers(0, 1000))
def test_prior_of_a_calibration_is_its_covariance(seed: int) -> None:
    """Also where sigmas are as far apart as metres and microtesla; 1e-6 is rounding of that."""
    rng = np.random.default_rng(seed)
    mixing = np.eye(15) + 0.2 * rng.normal(size=(15, 15))
    sigma = 10.0 ** rng.uniform(-4, 1, 15)
    covariance = mixing @ mixing.T * np.outer(sigma, sigma)
    W = stated_information_root(covariance)
    np.testing.assert_allclose(W @ covariance @ W.T, np.eye(15), atol=1e-6)
    exact = stated_information_root(np.zeros((15, 15)))
    assert np.isfinite(exact).all()


def test_a_scale_is_not_that_of_fixed_axes() -> None:
    with pytest.raises(ValueError, match="axes: fixed"):
        DriftOptions.model_validate({"axes": "fixed", "scale": 0.01})


def test_steps_along_fixed_axes_are_those_of_the_first_pose() -> None:
    """Put together along its axes they lead to the last pose, whatever the headings are."""
    rng = np.random.default_rng(5)
    R = Rotation.random(9, random_state=5).as_matrix()
    made = Trajectory(np.arange(9) * 10**9, R, rng.normal(size=(9, 3)), "map", "lidar")
    options = DriftOptions.model_validate({"axes": "fixed"})
    steps = odometry_steps(made, np.arange(9), options)
    assert steps.fixed_axes is not None
    end = made.p[0] + made.R[0] @ steps.fixed_axes.sum(axis=0)
    np.testing.assert_allclose(end, made.p[-1], atol=1e-12)  # rounding
    turns = made.R[0] @ steps.fixed_turns @ made.R[0].T
    np.testing.assert_allclose(turns @ made.R[:-1], made.R[1:], atol=1e-12)
    assert steps.until(3).fixed_axes is not None
