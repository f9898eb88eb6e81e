"""Reading the recordings that others made."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import Recording
from l2m_gtsam.errors import BagError, UnitsError
from l2m_gtsam.storage.bag import read_fields, read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions, TfChain
from l2m_gtsam.storage.inspect import inspect_bag


def assert_same(a: Recording, b: Recording) -> None:
    np.testing.assert_array_equal(a.trajectory.stamp_ns, b.trajectory.stamp_ns)
    np.testing.assert_allclose(a.trajectory.p, b.trajectory.p, atol=1e-9)
    np.testing.assert_allclose(a.trajectory.R, b.trajectory.R, atol=1e-9)
    assert [s.sensor for s in a.series] == [s.sensor for s in b.series]
    for x, y in zip(a.series, b.series, strict=True):
        np.testing.assert_array_equal(x.stamp_ns, y.stamp_ns)
        np.testing.assert_allclose(x.field, y.field, atol=1e-9)


@cache
def read_once(path: Path) -> Recording:
    return read_recording(path, BagOptions())


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("optitrack_run0_ros1.bag", "optitrack_run0_ros2_sqlite"),
        (
            "optitrack_run0_ros2_sqlite",
            "optitrack_run0_ros2_sqlite/optitrack_run0_ros2_sqlite.db3",
        ),
        ("optitrack_run1_ros1.bag", "optitrack_run1_ros2_mcap"),
        ("optitrack_run1_ros2_mcap", "optitrack_run1_ros2_mcap/optitrack_run1_ros2_mcap.mcap"),
    ],
)
def test_copies_of_one_drive_read_alike(shared_data: Path, a: str, b: str) -> None:
    one, other = (read_once(shared_data / "bags" / name) for name in (a, b))
    assert len(one.series[0]) > 10_000
    assert_same(one, other)


def test_one_tf_recording_reads_alike_from_ros1_and_ros2(shared_data: Path) -> None:
    options = BagOptions(tf=TfChain(frame="odom", child_frame="base_link"))
    one = read_trajectory(shared_data / "bags" / "evo_tf_example.bag", options)
    other = read_trajectory(shared_data / "bags" / "evo_tf_example_rosbag2", options)
    assert len(one) == 517
    np.testing.assert_array_equal(one.stamp_ns, other.stamp_ns)
    np.testing.assert_allclose(one.p, other.p, atol=1e-9)
    np.testing.assert_allclose(one.R, other.R, atol=1e-9)


def test_topics_without_a_leading_slash(shared_data: Path) -> None:
    path = shared_data / "bags" / "evo_ROS_example.bag"
    assert len(read_trajectory(path, BagOptions(poses="/groundtruth"))) > 12_000
    with pytest.raises(BagError, match=r"`bag.poses`: ORB-SLAM, S-PTAM, groundtruth"):
        read_trajectory(path, BagOptions())


@pytest.mark.parametrize("name", ["imu_tools_ardrone_imu.bag", "imu_tools_sparkfun_razor.bag"])
def test_directions_of_real_drivers_are_refused(shared_data: Path, name: str) -> None:
    with pytest.raises(UnitsError, match=r"0.0001 long, as written.*no unit at all"):
        read_fields(shared_data / "bags" / name, BagOptions())


def test_half_of_the_readings_are_nan(shared_data: Path) -> None:
    path = shared_data / "bags" / "imu_tools_phidgets_imu_upside_down.bag"
    (series,) = read_fields(path, BagOptions())
    share = float(np.mean(~np.isfinite(series.field).all(axis=1)))
    assert share == pytest.approx(0.5, abs=0.01)
    mag = next(t for t in inspect_bag(path, BagOptions()).topics if t.topic == "/imu/mag")
    assert mag.nan_share == share


def test_simulated_time_is_seen_in_the_clock_offset(shared_data: Path) -> None:
    report = inspect_bag(shared_data / "bags" / "evo_nav2_turtlebot.mcap", BagOptions())
    odometry = next(t for t in report.topics if t.topic == "/odom")
    assert odometry.clock_offset_s == pytest.approx(1.778e9, rel=1e-3)
