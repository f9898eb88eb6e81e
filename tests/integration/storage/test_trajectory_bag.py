"""`trajectory.mcap`: what is written comes back, by our reader and by evo."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.tools import file_interface
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import OutputError
from l2m_gtsam.recording.sync import twists
from l2m_gtsam.storage.bag import read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions, TfChain
from l2m_gtsam.storage.inspect import inspect_bag
from l2m_gtsam.storage.trajectory_files import TOPIC, LocalisedMotion, write_trajectory_bag
from l2m_gtsam.studies.slam_array.odometry import slipping
from tests.drives.slam import rounds

EVERY = 7  # a key pose


@pytest.fixture(scope="module")
def motion() -> LocalisedMotion:
    """Key poses of a true drive, and odometry that drifts in a frame of its own."""
    rng = np.random.default_rng(4)
    truth = rounds(6)
    rows = np.arange(0, len(truth), EVERY)
    root = 0.01 * rng.normal(size=(len(rows), 6, 6))
    localised = Trajectory(
        truth.stamp_ns[rows],
        truth.R[rows],
        truth.p[rows],
        "map",
        "lidar",
        root @ root.transpose(0, 2, 1),
    )
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    odometry = slipping(truth, rng)
    odometry = replace(odometry, R=turn @ odometry.R, p=odometry.p @ turn.T + 5, frame="/wheels")
    return LocalisedMotion(localised, twists(odometry, localised.stamp_ns), odometry)


def close(found: FloatArray, wanted: FloatArray) -> None:
    # Rounding of quaternions and of metres some metres from the origin.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


def test_poses_and_covariances_come_back(motion: LocalisedMotion, tmp_path: Path) -> None:
    path = tmp_path / "trajectory.mcap"
    write_trajectory_bag(path, motion)
    found, wanted = read_trajectory(path, BagOptions()), motion.localised
    assert (found.frame, found.child_frame) == ("map", "lidar")
    np.testing.assert_array_equal(found.stamp_ns, wanted.stamp_ns)
    close(found.p, wanted.p)
    close(found.R, wanted.R)
    assert found.covariance is not None
    assert wanted.covariance is not None
    close(found.covariance, wanted.covariance)
    assert [each.name for each in tmp_path.iterdir()] == ["trajectory.mcap"]


def test_transforms_lead_from_the_map_over_odometry_to_the_lidar(
    motion: LocalisedMotion, tmp_path: Path
) -> None:
    path = tmp_path / "trajectory.mcap"
    write_trajectory_bag(path, motion)
    whole = read_trajectory(path, BagOptions(tf=TfChain(frame="map", child_frame="lidar")))
    rows = np.searchsorted(whole.stamp_ns, motion.localised.stamp_ns)
    close(whole.p[rows], motion.localised.p)
    close(whole.R[rows], motion.localised.R)
    # Every recorded pose between the first and the last key pose has its own.
    assert len(whole) == EVERY * (len(motion.localised) - 1) + 1
    raw = read_trajectory(path, BagOptions(tf=TfChain(frame="wheels", child_frame="lidar")))
    np.testing.assert_array_equal(raw.stamp_ns, motion.odometry.stamp_ns)
    close(raw.p, motion.odometry.p)
    close(raw.R, motion.odometry.R)


@pytest.mark.parametrize(("frame", "named"), [("map", "odom"), ("", "odom"), ("/odom", "odom")])
def test_odometry_has_a_frame_of_its_own(
    motion: LocalisedMotion, tmp_path: Path, frame: str, named: str
) -> None:
    path = tmp_path / "trajectory.mcap"
    write_trajectory_bag(path, replace(motion, odometry=replace(motion.odometry, frame=frame)))
    raw = read_trajectory(path, BagOptions(tf=TfChain(frame=named, child_frame="lidar")))
    close(raw.p, motion.odometry.p)


def test_evo_reads_it(motion: LocalisedMotion, tmp_path: Path) -> None:
    path = tmp_path / "trajectory.mcap"
    write_trajectory_bag(path, motion)
    with Ros2Reader(path) as reader:
        found = file_interface.read_bag_trajectory(reader, TOPIC)
    wanted = motion.localised
    # evo counts seconds from 1970 in doubles, which hold quarters of a microsecond.
    np.testing.assert_allclose(found.timestamps, 1e-9 * wanted.stamp_ns, rtol=0, atol=1e-6)
    close(found.positions_xyz, wanted.p)
    close(Rotation.from_quat(found.orientations_quat_wxyz, scalar_first=True).as_matrix(), wanted.R)


def test_twists_are_velocities_along_the_axes_of_the_lidar(
    motion: LocalisedMotion, tmp_path: Path
) -> None:
    """At 0.6 m/s forward, as the drive is: the vehicle's x axis is its heading."""
    path = tmp_path / "trajectory.mcap"
    write_trajectory_bag(path, motion)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Ros2Reader(path) as reader:
        messages: list[Any] = [
            store.deserialize_cdr(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic == TOPIC
        ]
    told = np.array(
        [
            [
                getattr(part, axis)
                for part in (m.twist.twist.angular, m.twist.twist.linear)
                for axis in "xyz"
            ]
            for m in messages
        ]
    )
    np.testing.assert_array_equal(told, motion.twist)
    # The rosette's speed varies, its slip is 1 %, and it heaves and tilts a little.
    assert 0.4 < told[:, 3].min() < told[:, 3].max() < 1.0
    assert np.abs(told[:, 4:]).max() < 0.1
    turned = Rotation.from_matrix(motion.localised.R).as_euler("ZYX")[:, 0]
    rate = np.gradient(np.unwrap(turned), 1e-9 * motion.localised.stamp_ns.astype(float))
    # Differences over two key poses beside those over 0.1 s.
    np.testing.assert_allclose(told[1:-1, 2], rate[1:-1], atol=0.1)


def test_it_is_inspected(motion: LocalisedMotion, tmp_path: Path) -> None:
    path = tmp_path / "trajectory.mcap"
    write_trajectory_bag(path, motion)
    report = inspect_bag(path, BagOptions())
    assert {each.topic for each in report.topics} >= {TOPIC, "/tf"}


def test_it_replaces_the_one_before_or_nothing(motion: LocalisedMotion, tmp_path: Path) -> None:
    path = tmp_path / "trajectory.mcap"
    path.write_text("old")
    short = replace(motion, twist=motion.twist[:3])  # fails on the way
    with pytest.raises(IndexError):
        write_trajectory_bag(path, short)
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
    write_trajectory_bag(path, motion)
    assert len(read_trajectory(path, BagOptions())) == len(motion.localised)
    with pytest.raises(OutputError):
        write_trajectory_bag(tmp_path / "none" / "trajectory.mcap", motion)
