"""What is in recordings that others made, and what would be used of them."""

from pathlib import Path

import pytest

from l2m_gtsam.storage.bag_options import BagOptions, TfChain
from l2m_gtsam.storage.inspect import BagReport, TopicReport, inspect_bag


def topic(report: BagReport, name: str) -> TopicReport:
    (found,) = (each for each in report.topics if each.topic == name)
    return found


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("imu_tools_ardrone_imu.bag", "/ardrone/mag"),
        ("imu_tools_sparkfun_razor.bag", "/imu/mag"),
    ],
)
def test_directions_are_reported_not_raised(shared_data: Path, name: str, field: str) -> None:
    report = inspect_bag(shared_data / "bags" / name, BagOptions())
    assert topic(report, field).use.startswith("refused")
    assert "no unit at all" in topic(report, field).use
    found = topic(report, field).strength
    assert found is not None
    # 1e-4 as read in tesla; the ardrone driver computes in single precision.
    assert found.median == pytest.approx(100.0, rel=1e-6)
    assert any("no poses" in line for line in report.obstacles)


def test_the_share_of_nan_is_reported(shared_data: Path) -> None:
    path = shared_data / "bags" / "imu_tools_phidgets_imu_upside_down.bag"
    mag = topic(inspect_bag(path, BagOptions()), "/imu/mag")
    assert mag.count == 13_964
    # 6,990 of 13,964 messages have NaN in every axis.
    assert mag.nan_share == pytest.approx(6990 / 13_964, abs=1e-12)
    assert mag.use == "magnetic readings"
    assert mag.strength is not None
    assert 34 < mag.strength.low < mag.strength.median < mag.strength.high < 54


@pytest.mark.parametrize("name", ["optitrack_run1_ros1.bag", "optitrack_run1_ros2_mcap"])
def test_one_drive_is_reported_alike(shared_data: Path, name: str) -> None:
    report = inspect_bag(shared_data / "bags" / name, BagOptions())
    mag, pose = topic(report, "/imu/mag"), topic(report, "/optitrack/pose")
    assert report.obstacles == ()
    assert (mag.count, mag.frames, pose.frames) == (10_137, ("mag",), ("map",))
    assert mag.rate_hz == pytest.approx(100.0, rel=0.02)
    assert mag.clock_offset_s == 0.0
    assert pose.use.startswith("poses")


def test_the_clock_of_a_simulation_stands_out(shared_data: Path) -> None:
    path = shared_data / "bags" / "evo_nav2_turtlebot.mcap"
    odometry = topic(inspect_bag(path, BagOptions()), "/odom")
    # Measured: record time is 1,778,233,424.6 to 1,778,233,425.3 s after the header stamps.
    assert odometry.clock_offset_s == pytest.approx(1_778_233_425, abs=1.0)
    assert odometry.span_s[1] < 1e6


def test_a_tf_chain_is_what_would_be_used(shared_data: Path) -> None:
    path = shared_data / "bags" / "evo_tf_example.bag"
    chain = TfChain(frame="odom", child_frame="base_link")
    report = inspect_bag(path, BagOptions(tf=chain))
    assert topic(report, "/tf").use == "poses (chain odom to base_link)"
    assert topic(report, "/tf").frames == ("odom",)
    assert len(report.obstacles) == 1  # no magnetometer
