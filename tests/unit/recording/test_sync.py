"""Time association: interpolation, gaps, edges, thinning and the account of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, Recording, SourceFile, Trajectory
from l2m_gtsam.errors import SyncError
from l2m_gtsam.recording.sync import SyncOptions, synchronise, with_offsets

KEEP_ALL = SyncOptions(thin_distance_m=0, thin_angle_deg=0)


def at(seconds: float | np.ndarray) -> np.ndarray:
    return np.asarray(np.round(np.asarray(seconds) * 1e9), dtype=np.int64)


def turning_drive(stamps: np.ndarray, start_s: float = 1.7e9) -> Trajectory:
    """1 m/s along x while turning 0.5 rad/s about z."""
    R = Rotation.from_rotvec(np.outer(stamps, [0, 0, 0.5])).as_matrix()
    p = np.outer(stamps, [1.0, 0, 0])
    return Trajectory(at(start_s) + at(stamps), R, p, "map", "lidar")


def series(stamps: np.ndarray, field: np.ndarray | None = None, name: str = "mag") -> FieldSeries:
    field = np.tile([20.0, 0, -40], (len(stamps), 1)) if field is None else field
    return FieldSeries(name, "/" + name, name, at(1.7e9) + at(stamps), field)


def recording(trajectory: Trajectory, *sensors: FieldSeries) -> Recording:
    return Recording(trajectory, sensors, SourceFile("drive.bag", "0"))


def test_interpolation_is_exact_on_a_constant_motion() -> None:
    poses = turning_drive(np.arange(0, 10, 0.1))
    stamps = np.sort(np.random.default_rng(0).uniform(0, 9.9, 200))
    readings = synchronise(recording(poses, series(stamps)), KEEP_ALL).readings
    expected = turning_drive(stamps)
    # ns stamps at 1 m/s and 0.5 rad/s limit the agreement to 1e-9.
    np.testing.assert_allclose(readings.p_map_lidar, expected.p, atol=2e-9)
    np.testing.assert_allclose(readings.R_map_lidar, expected.R, atol=2e-9)


def test_everything_dropped_is_counted() -> None:
    poses = turning_drive(np.concatenate([np.arange(0, 3, 0.1), np.arange(5, 8, 0.1)]))
    stamps = np.array([-0.5, 0.0, 1.05, 2.0, 4.0, 6.0, 6.5, 7.9, 8.5])
    field = np.tile([20.0, 0, -40], (9, 1))
    field[6, 1] = np.nan
    counts = synchronise(recording(poses, series(stamps, field)), KEEP_ALL).counts[0]
    assert (counts.received, counts.not_finite, counts.outside_trajectory) == (9, 1, 2)
    assert (counts.in_pose_gap, counts.thinned, counts.kept) == (1, 0, 5)


def test_readings_between_poses_that_turn_far_are_dropped() -> None:
    """Who turns by 90 degrees in 0.4 s from rest has turned by 22, not 45, after half of it."""
    poses = turning_drive(np.arange(0, 3, 0.1))
    turned = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    R = np.where(np.arange(len(poses))[:, None, None] >= 20, poses.R @ turned, poses.R)
    rows = np.setdiff1d(np.arange(len(poses)), np.arange(17, 20))
    stamps = np.array([1.0, 1.55, 1.65, 1.9, 2.05])
    sudden = replace(poses, R=R)[rows]
    found = synchronise(recording(sudden, series(stamps)), KEEP_ALL)
    assert (found.counts[0].in_pose_gap, found.counts[0].kept) == (2, 3)
    around = synchronise(recording(sudden, series(stamps)), KEEP_ALL, largest_offset_s=0.1)
    assert (around.counts[0].in_pose_gap, around.counts[0].kept) == (4, 1)


def test_repeated_stamps_are_counted_and_the_finite_one_is_kept() -> None:
    poses = turning_drive(np.arange(0, 3, 0.1))
    stamps = np.array([0.5, 0.5, 0.5, 1.0, 1.0])
    field = np.tile([20.0, 0, -40], (5, 1))
    field[0, 0] = np.nan
    result = synchronise(recording(poses, series(stamps, field)), KEEP_ALL)
    counts = result.counts[0]
    assert (counts.received, counts.not_finite, counts.repeated, counts.kept) == (5, 1, 2, 2)


def test_a_vehicle_at_rest_at_the_origin_keeps_one_reading() -> None:
    """Cells are centred on zero, where parked vehicles stand: jitter must not cross an edge."""
    rng = np.random.default_rng(2)
    stamps = np.arange(0, 100, 0.1)
    R = Rotation.from_rotvec(rng.normal(0, 1e-4, (1000, 3))).as_matrix()
    p = rng.normal(0, 1e-3, (1000, 3))
    poses = Trajectory(at(1.7e9) + at(stamps), R, p, "map", "lidar")
    assert synchronise(recording(poses, series(stamps)), SyncOptions()).counts[0].kept == 1


def test_a_reading_on_a_pose_needs_no_neighbour() -> None:
    poses = turning_drive(np.array([0.0, 10.0, 20.0]))
    result = synchronise(recording(poses, series(np.array([0.0, 10.0, 15.0, 20.0]))), KEEP_ALL)
    assert result.counts[0].kept == 3


def test_thinning_keeps_one_reading_per_cell() -> None:
    """A vehicle parked for 60 s of 100 s at 10 Hz: its readings fall into few cells."""
    rng = np.random.default_rng(1)
    stamps = np.arange(0, 100, 0.1)
    x = np.clip(stamps - 30, 0, 40)  # parked, 40 m drive, parked
    p = np.outer(x, [1.0, 0, 0]) + rng.normal(0, 1e-3, (1000, 3))
    poses = Trajectory(at(1.7e9) + at(stamps), np.tile(np.eye(3), (1000, 1, 1)), p, "map", "lidar")
    options = SyncOptions(thin_distance_m=0.5, thin_angle_deg=5)
    result = synchronise(recording(poses, series(stamps)), options)
    assert 79 <= result.counts[0].kept <= 83  # 40 m in cells of 0.5 m
    assert result.counts[0].thinned == 1000 - result.counts[0].kept


def test_sensors_are_one_batch() -> None:
    poses = turning_drive(np.arange(0, 10, 0.1))
    sensors = [series(np.arange(0, 9, 0.5), name=f"m{i}") for i in range(3)]
    readings = synchronise(recording(poses, *sensors), KEEP_ALL).readings
    assert readings.sensors == ("m0", "m1", "m2")
    assert [readings.rows_of(i) for i in range(3)] == [slice(0, 18), slice(18, 36), slice(36, 54)]


def test_other_clocks_are_named_in_one_line() -> None:
    poses = turning_drive(np.arange(0, 10, 0.1), start_s=900.0)
    with pytest.raises(SyncError, match=r"drive.bag: .*1700000000.000.*900.000") as error:
        synchronise(recording(poses, series(np.arange(0, 9, 0.5))), KEEP_ALL)
    assert "\n" not in str(error.value)
    apart = replace(
        recording(poses, series(np.arange(0, 9, 0.5))), poses=SourceFile("drive.tum", "")
    )
    with pytest.raises(SyncError, match=r"`bag.pose_file.offset_s` is added .* of drive.tum$"):
        synchronise(apart, KEEP_ALL)


def test_readings_need_poses_as_far_around_as_their_clock_may_be_off() -> None:
    """Poses from 0 to 2.9 s and from 5 to 7.9 s; half a second at each of the four ends is lost."""
    poses = turning_drive(np.concatenate([np.arange(0, 3, 0.1), np.arange(5, 8, 0.1)]))
    stamps = np.array([0.2, 0.6, 2.3, 2.6, 4.0, 5.2, 5.6, 7.3, 7.6])
    result = synchronise(recording(poses, series(stamps)), KEEP_ALL, 0.5)
    counts = result.counts[0]
    assert (counts.outside_trajectory, counts.in_pose_gap, counts.kept) == (2, 3, 4)
    kept = 1e-9 * (result.readings.stamp_ns - result.readings.stamp_ns[0])
    np.testing.assert_allclose(kept, [0, 1.7, 5.0, 6.7], atol=1e-6)


def test_other_offsets_are_other_poses() -> None:
    """The pose at stamp + offset, sensor by sensor, with the velocities of the drive."""
    poses = turning_drive(np.arange(0, 10, 0.1))
    stamps = np.sort(np.random.default_rng(3).uniform(1, 8.9, 50))
    sensors = series(stamps), series(stamps, name="late")
    readings = synchronise(recording(poses, *sensors), KEEP_ALL, 0.5).readings
    moved = with_offsets(readings, poses, np.array([0.0, 0.3]))
    expected = turning_drive(np.concatenate([stamps, stamps + 0.3]))
    np.testing.assert_allclose(moved.p_map_lidar, expected.p, atol=2e-9)
    np.testing.assert_allclose(moved.R_map_lidar, expected.R, atol=2e-9)
    assert moved.motion is not None
    np.testing.assert_array_equal(moved.motion.offset, np.repeat([0.0, 0.3], 50))
    v = np.einsum("nji,j->ni", expected.R, [1.0, 0, 0])
    # The chord over a tenth of a second, seen from its middle.
    np.testing.assert_allclose(moved.motion.twist_lidar[:, :3], [[0, 0, 0.5]] * 100, atol=1e-7)
    np.testing.assert_allclose(moved.motion.twist_lidar[:, 3:], v, atol=1e-7)


def test_accelerations_are_those_of_the_drive() -> None:
    """A vehicle that becomes faster along x, and turns faster about z."""
    steady, stamps = turning_drive(np.arange(0, 10, 0.1)), np.arange(1, 9, 0.1)
    seconds = 1e-9 * (steady.stamp_ns - steady.stamp_ns[0])
    R = Rotation.from_rotvec(np.outer(0.15 * seconds**2, [0, 0, 1.0])).as_matrix()
    poses = replace(steady, R=R, p=np.outer(0.2 * seconds**2, [1.0, 0, 0]))
    readings = synchronise(recording(poses, series(stamps)), KEEP_ALL).readings
    assert readings.motion is not None
    found = readings.motion.acceleration_lidar
    np.testing.assert_allclose(found[:, :3], [[0, 0, 0.3]] * len(stamps), atol=1e-6)
    expected = readings.R_map_lidar.transpose(0, 2, 1) @ [0.4, 0, 0]
    # Stamps are whole nanoseconds: at 3.6 m/s, over 0.1 s twice.
    np.testing.assert_allclose(found[:, 3:], expected, atol=1e-6)


def test_beyond_its_poses_a_lidar_stands_still() -> None:
    poses = turning_drive(np.arange(0, 2, 0.1))
    readings = synchronise(recording(poses, series(np.array([0.5, 1.5]))), KEEP_ALL).readings
    moved = with_offsets(readings, poses, np.array([3.0]))
    np.testing.assert_allclose(moved.p_map_lidar, np.tile(poses.p[-1], (2, 1)))
    assert moved.motion is not None
    np.testing.assert_array_equal(moved.motion.twist_lidar, 0)
