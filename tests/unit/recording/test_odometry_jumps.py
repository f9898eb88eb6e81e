"""Jumps of odometry: found wherever they are, taken out, and never seen in a smooth drive."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import between, difference, moved
from l2m_gtsam.recording.odometry_jumps import (
    JumpOptions,
    RepairedOdometry,
    jump_notes,
    without_jumps,
)
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.options import DriftOptions
from tests.drives.faults import jumped, shift
from tests.drives.slam import RATE_HZ, rounds

OPTIONS = JumpOptions()
# Headings are gradients of the way, which at its two ends are half a step off.
DRIVE = rounds(30)[np.arange(1, 599)]


def pose(trajectory: Trajectory, k: int) -> RigidTransform:
    return RigidTransform(trajectory.R[k], trajectory.p[k])


def step_nees(true: Trajectory, repaired: RepairedOdometry) -> float:
    """Return the squared errors of the motions put in place of jumps, in sigmas of the graph's."""
    total, least = 0.0, drift_covariance(np.eye(3)[None], np.zeros((1, 3)), DriftOptions())[0]
    for each in repaired.jumps:
        step, other = (
            between(pose(part, each.row), pose(part, each.row + 1))
            for part in (repaired.trajectory, true)
        )
        error = difference(step, other)
        total += float(error @ np.linalg.solve(each.covariance + least, error))
    return total


@given(faster=st.floats(0.05, 3.0), every=st.integers(1, 20))
def test_smooth_drives_have_no_jumps(faster: float, every: int) -> None:
    """At 3 cm/s to 1.8 m/s, at one pose per 20 s to 60 per second: as odometry came it is kept.

    At 3.6 m/s this drive itself turns by 800 deg/s^2 and takes its bends with 7 m/s^2, which is
    more than the options let a vehicle do.
    """
    way = (DRIVE.stamp_ns - DRIVE.stamp_ns[0]) / faster
    drive = replace(DRIVE, stamp_ns=way.astype(np.int64))[np.arange(0, len(DRIVE), every)]
    repaired = without_jumps(drive, OPTIONS)
    assert repaired.jumps == ()
    assert repaired.left_out == 0
    assert repaired.trajectory is not None
    np.testing.assert_array_equal(repaired.trajectory.p, drive.p)
    assert jump_notes(repaired.jumps) == repaired.notes() == ()


@given(st.integers(0, 1000), st.floats(0.0, 0.01), st.floats(0.0, 1.0))
def test_noise_of_poses_is_no_jump(seed: int, position: float, degrees: float) -> None:
    """Poses of motion capture at 100 Hz, each wrong by itself by up to 1 cm and 1 degree."""
    rng = np.random.default_rng(seed)
    drive = replace(DRIVE, stamp_ns=DRIVE.stamp_ns[0] + 10_000_000 * np.arange(len(DRIVE)))
    turned = Rotation.from_rotvec(np.deg2rad(degrees) * rng.normal(size=(len(DRIVE), 3)))
    noisy = replace(
        drive,
        R=drive.R @ turned.as_matrix(),
        p=drive.p + position * rng.normal(size=drive.p.shape),
    )
    assert without_jumps(noisy, OPTIONS).jumps == ()


@pytest.mark.parametrize("rate_hz", [1, 2, 5, 10])
def test_sharp_turns_between_few_poses_are_no_jumps(rate_hz: int) -> None:
    """A square with turns on the spot at 90 degrees per second, stops of a second, 1 m/s."""
    legs = [(0.0, 0.0, 1.0), (1.0, 0.0, 3.0), (0.0, 0.0, 1.0), (0.0, np.pi / 2, 1.0)] * 4
    dt = 1 / (10 * rate_hz)
    v, w = (
        np.concatenate([np.full(round(each[2] / dt), each[part]) for each in legs])
        for part in (0, 1)
    )
    # Over half a second speeds change, as 2 m/s^2 and 3 rad/s^2 have it.
    smooth = np.ones(round(0.5 / dt)) / round(0.5 / dt)
    v, w = np.convolve(v, smooth, "same"), np.convolve(w, smooth, "same")
    angle = np.append(0, np.cumsum(w * dt))
    ahead = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    p = np.vstack([np.zeros(3), np.cumsum(v[:, None] * ahead[:-1] * dt, axis=0)])
    stamps = np.arange(len(p)) * round(1e9 * dt)
    R = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    drive = Trajectory(stamps, R, p, "odom", "lidar")[np.arange(0, len(p), 10)]
    assert without_jumps(drive, OPTIONS).jumps == ()


@given(
    row=st.integers(0, len(DRIVE) - 2),
    metres=st.floats(0.15, 50.0),
    degrees=st.floats(-179, 179),
    heading=st.floats(-3.1, 3.1),
)
def test_a_jump_anywhere_is_found_and_taken_out(
    row: int, metres: float, degrees: float, heading: float
) -> None:
    """The drive without it comes out as well as the step that is put in its place is known."""
    repaired = without_jumps(jumped(DRIVE, shift(row, metres, degrees, heading)), OPTIONS)
    (jump,) = repaired.jumps
    assert jump.row == row
    assert jump.seconds == pytest.approx((row + 1) / RATE_HZ)
    assert jump.distance_m == pytest.approx(metres, abs=0.03)
    assert jump.angle_deg == pytest.approx(abs(degrees), abs=2)
    # Chi squared of 6 degrees of freedom passes 22.5 once in 1,000; there are 600 places.
    assert step_nees(DRIVE, repaired) < 22.5
    np.testing.assert_array_equal(repaired.rows, [row, row + 1])
    (note,) = jump_notes(repaired.jumps)
    assert f"odometry jumps by {jump.distance_m:.2f} m and {jump.angle_deg:.1f} deg" in note


@given(st.sets(st.integers(0, len(DRIVE) // 6 - 1), min_size=2, max_size=12), st.integers(0, 99))
def test_several_jumps_are_taken_out(places: set[int], seed: int) -> None:
    """At least six steps apart."""
    rng = np.random.default_rng(seed)
    shifts = [
        shift(6 * k, rng.uniform(0.15, 2), rng.uniform(-90, 90), rng.uniform(-3, 3))
        for k in sorted(places)
    ]
    repaired = without_jumps(jumped(DRIVE, *shifts), OPTIONS)
    assert [each.row for each in repaired.jumps] == [each.row for each in shifts]
    # 6 in the mean for each, and once in 1,000 as much as this for one of them.
    assert step_nees(DRIVE, repaired) < 22.5 + 6 * (len(shifts) - 1) * 2
    if len(shifts) > 3:
        assert jump_notes(repaired.jumps)[-1] == f"odometry jumps {len(shifts) - 3} more times"


def test_a_rotation_alone_is_a_jump() -> None:
    (jump,) = without_jumps(jumped(DRIVE, shift(200, 0.0, 10.0)), OPTIONS).jumps
    assert jump.angle_deg == pytest.approx(10, abs=0.5)
    assert jump.distance_m < 0.03


def test_a_pose_that_lies_elsewhere_is_left_out() -> None:
    """There and back: what is known of the way past it stays known."""
    stray = replace(DRIVE, p=DRIVE.p.copy())
    stray.p[100] += [0.4, 0.0, 0.0]
    repaired = without_jumps(stray, OPTIONS)
    assert repaired.jumps == ()
    assert repaired.left_out == 1
    np.testing.assert_array_equal(repaired.trajectory.p, np.delete(DRIVE.p, 100, axis=0))
    (note,) = repaired.notes()
    assert note.endswith("are left out: 1")


def carried_by_hand(seconds: float, rate_hz: float = 20.0) -> Trajectory:
    """Poses of what a hand turns to and fro, by up to 390 deg/s and 2500 deg/s^2."""
    at = np.arange(0, seconds, 1 / rate_hz)
    turns = np.column_stack([np.sin(6.1 * at), 0.9 * np.sin(5.3 * at + 1), np.sin(4.7 * at + 2)])
    p = 0.2 * np.column_stack([np.sin(2.1 * at), np.sin(1.7 * at + 1), 0.5 * np.sin(2.9 * at)])
    R = Rotation.from_rotvec(turns).as_matrix()
    return Trajectory(np.round(1e9 * at).astype(np.int64), R, p, "map", "lidar")


@pytest.mark.parametrize("lost", [2, 4, 6])
def test_a_hand_turns_as_suddenly_in_a_gap_as_elsewhere(lost: int) -> None:
    """Tracking that is lost for 0.15 to 0.35 s, in 30 places: steps over it are as recorded."""
    drive = carried_by_hand(120)
    gone = np.concatenate([k + np.arange(lost) for k in range(60, 2300, 75)])
    with_gaps = drive[np.setdiff1d(np.arange(len(drive)), gone)]
    assert without_jumps(with_gaps, OPTIONS).jumps == ()
    vehicle = OPTIONS.model_copy(update={"gaps": 1e-6})
    assert without_jumps(with_gaps, vehicle).jumps  # by what a vehicle does they would be jumps


@pytest.mark.parametrize("count", [40, 100, 200])
@pytest.mark.parametrize("seconds", [2.0, 2.2, 2.4])
def test_a_jump_over_a_lost_pose_is_found(count: int, seconds: float) -> None:
    """It is no part of the motion that it is compared with, at any place of a short drive."""
    drive = DRIVE[np.arange(count)]
    for row in range(4, count - 6, max(count // 20, 1)):
        away = jumped(drive, shift(row, 1.0, 0.0))
        late = round((seconds - 1) * 1e9 / RATE_HZ) * (np.arange(count) > row)
        (jump,) = without_jumps(replace(away, stamp_ns=away.stamp_ns + late), OPTIONS).jumps
        assert jump.row == row


def test_what_is_a_jump_in_a_gap_does_not_depend_on_itself() -> None:
    """Poses of a hand at 50 Hz with 18 gaps of 0.3 s."""
    drive = carried_by_hand(40, 50.0)
    gone = np.concatenate([k + np.arange(15) for k in range(60, 1960, 105)])
    with_gaps = drive[np.setdiff1d(np.arange(len(drive)), gone)]
    assert without_jumps(with_gaps, OPTIONS).jumps == ()


def test_a_jump_in_a_gap_of_a_hand_is_found() -> None:
    drive = carried_by_hand(120)
    away = jumped(drive, shift(1000, 3.0, 0.0))
    away = away[np.setdiff1d(np.arange(len(away)), 998 + np.arange(6))]
    (jump,) = without_jumps(away, OPTIONS).jumps
    assert jump.distance_m == pytest.approx(3.0, abs=0.4)  # of the hand's own way meanwhile


def test_a_gap_is_no_jump() -> None:
    """Two seconds without odometry while the vehicle goes on, stops, or turns."""
    kept = np.r_[0:200, 240 : len(DRIVE)]
    gap = DRIVE[kept]
    assert without_jumps(gap, OPTIONS).jumps == ()
    stopped = DRIVE[np.arange(len(DRIVE))]
    stopped.stamp_ns[200:] += 2_000_000_000
    assert without_jumps(stopped, OPTIONS).jumps == ()
    # Beyond what it can accelerate to meanwhile it is one, and its place is known to a decimetre.
    away = jumped(gap, shift(199, 40.0, 0.0))
    (jump,) = without_jumps(away, OPTIONS).jumps
    assert 0.03 < np.sqrt(jump.covariance[3, 3]) < 1.0


def test_what_is_stated_of_poses_goes_on_past_a_jump() -> None:
    """Covariances grow by what each step states, and at the jump by what is known of its motion."""
    Q = np.diag([1e-6, 2e-6, 3e-6, 1e-5, 2e-5, 3e-5])

    def accumulated(drive: Trajectory, own: dict[int, FloatArray]) -> Trajectory:
        P = [1e-6 * np.eye(6)]
        for k in range(1, len(drive)):
            step = between(pose(drive, k - 1), pose(drive, k))
            P.append(moved(P[-1][None], step)[0] + own.get(k - 1, Q))
        return replace(drive, covariance=np.stack(P))

    shifts = shift(150, 0.5, 10.0), shift(300, 2.0, -60.0)
    repaired = without_jumps(accumulated(jumped(DRIVE, *shifts), {}), OPTIONS)
    own = {each.row: each.covariance for each in repaired.jumps}
    assert sorted(own) == [150, 300]
    expected = accumulated(repaired.trajectory, own).covariance
    assert expected is not None
    assert repaired.trajectory.covariance is not None
    np.testing.assert_allclose(repaired.trajectory.covariance, expected, atol=1e-9)


@pytest.mark.parametrize("count", range(1, 6))
def test_too_few_poses_have_no_jumps(count: int) -> None:
    few = DRIVE[np.arange(count)]
    assert len(without_jumps(few, OPTIONS).trajectory) == count


def test_poses_that_jump_everywhere_are_left_as_they_are() -> None:
    """Nothing tells how the vehicle moved."""
    rng = np.random.default_rng(1)
    wild = replace(DRIVE, p=10 * rng.normal(size=DRIVE.p.shape))
    repaired = without_jumps(wild, OPTIONS)
    assert len(repaired.trajectory) > len(DRIVE) / 2
