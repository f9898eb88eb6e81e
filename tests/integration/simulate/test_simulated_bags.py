"""Simulated recordings, written as bags of three kinds, read back through rosbags."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.errors import OutputError
from l2m_gtsam.simulate.bag_writer import BagKind, WriterOptions, write_bag
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.recorder import SimulatedDrive
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import ScenarioOptions, simulate
from l2m_gtsam.simulate.sensors import (
    MappingSuiteOptions,
    NoiseOptions,
    SamplingOptions,
    SensorArrayOptions,
)
from l2m_gtsam.storage.bag import read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions as ReadOptions

KINDS = list(BagKind)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    options = ScenarioOptions(
        floor_plan=FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
        suite=MappingSuiteOptions(lateral=(0.0,), heights=(0.0,)),
        mapping_sampling=SamplingOptions(field_rate=0.5, pose_rate=1.0),
        array=SensorArrayOptions(count=3),
        calibration_route=CalibrationRouteOptions(turns=1),
    )
    return simulate(options).calibration


@dataclass(frozen=True)
class Message:
    """What a bag says about one message."""

    record_ns: int
    content: Any

    @property
    def stamp_ns(self) -> int:
        stamp = self.content.header.stamp
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def bag_path(folder: Path, kind: BagKind) -> Path:
    return folder / ("drive.bag" if kind is BagKind.ROS1 else f"drive_{kind}")


def read_topics(path: Path) -> dict[str, list[Message]]:
    """All messages by topic, in the bag's own order."""
    topics: dict[str, list[Message]] = {}
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        for connection, record_ns, data in reader.messages():
            content = reader.deserialize(data, connection.msgtype)
            topics.setdefault(connection.topic, []).append(Message(record_ns, content))
    return topics


def stamps(messages: list[Message]) -> IntArray:
    return np.array([message.stamp_ns for message in messages])


def values(part: Any, names: str) -> FloatArray:
    return np.array([getattr(part, name) for name in names])


@pytest.mark.parametrize("kind", KINDS)
def test_readings_come_back(tmp_path: Path, drive: SimulatedDrive, kind: BagKind) -> None:
    write_bag(bag_path(tmp_path, kind), kind, drive.recording)
    topics = read_topics(bag_path(tmp_path, kind))
    assert set(topics) == {"/odometry", "/mag_00", "/mag_01", "/mag_02"}
    for series in drive.recording.series:
        messages = topics[series.topic]
        np.testing.assert_array_equal(stamps(messages), series.stamp_ns)
        field = np.array([values(m.content.magnetic_field, "xyz") for m in messages])
        # Two roundings, of the change to tesla and back.
        np.testing.assert_allclose(field * 1e6, series.field, rtol=1e-15, atol=0)
        assert {m.content.header.frame_id for m in messages} == {series.frame}
        covariance = messages[0].content.magnetic_field_covariance
        # Default noise of 0.1 uT; rounding of one product.
        np.testing.assert_allclose(covariance, np.eye(3).ravel() * 1e-14, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_poses_come_back(tmp_path: Path, drive: SimulatedDrive, kind: BagKind) -> None:
    write_bag(bag_path(tmp_path, kind), kind, drive.recording)
    messages = read_topics(bag_path(tmp_path, kind))["/odometry"]
    trajectory = drive.recording.trajectory
    np.testing.assert_array_equal(stamps(messages), trajectory.stamp_ns)
    poses = [message.content.pose.pose for message in messages]
    np.testing.assert_array_equal([values(pose.position, "xyz") for pose in poses], trajectory.p)
    R = Rotation.from_quat([values(pose.orientation, "xyzw") for pose in poses]).as_matrix()
    # Rounding of a quaternion there and back.
    np.testing.assert_allclose(R, trajectory.R, rtol=0, atol=1e-14)
    first = messages[0].content
    assert (first.header.frame_id, first.child_frame_id) == ("map", "lidar")
    covariance = first.pose.covariance.reshape(6, 6)
    # The default noise, alike along all axes; rounding of a square and of two rotations.
    sigmas = [NoiseOptions().position] * 3 + [np.deg2rad(NoiseOptions().rotation)] * 3
    np.testing.assert_allclose(covariance, np.diag(np.square(sigmas)), rtol=1e-12, atol=1e-20)


def uneven(trajectory: Trajectory) -> Trajectory:
    """Poses whose errors differ along all axes, are correlated and grow."""
    root = np.tril(np.random.default_rng(7).normal(size=(6, 6)))
    scale = np.array([1e-3] * 3 + [5e-3] * 3)
    growth = np.linspace(1, 2, len(trajectory))[:, None, None]
    return replace(trajectory, covariance=growth * (root @ root.T) * np.outer(scale, scale))


@pytest.mark.parametrize("kind", KINDS)
def test_covariances_come_back(tmp_path: Path, drive: SimulatedDrive, kind: BagKind) -> None:
    path = bag_path(tmp_path, kind)
    trajectory = uneven(drive.recording.trajectory)
    write_bag(path, kind, replace(drive.recording, trajectory=trajectory))
    found = read_trajectory(path, ReadOptions())
    assert found.covariance is not None
    assert trajectory.covariance is not None
    # Rotated there and back: a few roundings of entries up to 2e-4 (m^2).
    np.testing.assert_allclose(found.covariance, trajectory.covariance, rtol=0, atol=1e-17)


def test_unknown_covariances_are_written_as_zero(tmp_path: Path, drive: SimulatedDrive) -> None:
    trajectory = replace(drive.recording.trajectory, covariance=None)
    write_bag(tmp_path / "drive", BagKind.MCAP, replace(drive.recording, trajectory=trajectory))
    for message in read_topics(tmp_path / "drive")["/odometry"]:
        assert not message.content.pose.covariance.any()
    assert read_trajectory(tmp_path / "drive", ReadOptions()).covariance is None


@pytest.mark.parametrize("kind", KINDS)
def test_record_stamps_follow_by_a_latency(
    tmp_path: Path, drive: SimulatedDrive, kind: BagKind
) -> None:
    options = WriterOptions(latency=0.002, latency_spread=0.001)
    write_bag(bag_path(tmp_path, kind), kind, drive.recording, options)
    for messages in read_topics(bag_path(tmp_path, kind)).values():
        record = np.array([message.record_ns for message in messages])
        assert np.diff(record).min() >= 0
        latency = (record - stamps(messages)) / 1e9
        assert latency.min() >= 0.002
        # The mean of n exponential times is known to 1/sqrt(n): five of these.
        spread = 0.001 * 5 / np.sqrt(len(messages))
        assert latency.mean() == pytest.approx(0.003, abs=spread)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_stand_in_record_order(
    tmp_path: Path, drive: SimulatedDrive, kind: BagKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    for writer in (Ros1Writer, Ros2Writer):
        plain = writer.write

        def spy(self: Any, connection: Any, timestamp: int, data: Any, plain: Any = plain) -> None:
            written.append(timestamp)
            plain(self, connection, timestamp, data)

        monkeypatch.setattr(writer, "write", spy)
    write_bag(bag_path(tmp_path, kind), kind, drive.recording)
    recording = drive.recording
    assert len(written) == len(recording.trajectory) + sum(map(len, recording.series))
    assert written == sorted(written)


@pytest.mark.parametrize("kind", [BagKind.ROS1, BagKind.MCAP])
def test_same_recording_gives_the_same_bytes(
    tmp_path: Path, drive: SimulatedDrive, kind: BagKind
) -> None:
    def content(folder: str) -> bytes:
        path = bag_path(tmp_path / folder, kind)
        write_bag(path, kind, drive.recording)
        file = path if path.is_file() else path / f"{path.name}.mcap"
        return file.read_bytes()

    assert content("first") == content("second")


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_replaced_and_nothing_is_left_beside_it(
    tmp_path: Path, drive: SimulatedDrive, kind: BagKind
) -> None:
    path = bag_path(tmp_path, kind)
    write_bag(path, kind, drive.recording, WriterOptions(odometry_topic="/old"))
    write_bag(path, kind, drive.recording)
    assert "/old" not in read_topics(path)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", KINDS)
def test_a_failed_write_leaves_nothing(
    tmp_path: Path, drive: SimulatedDrive, kind: BagKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Ros1Writer, "write", full)
    monkeypatch.setattr(Ros2Writer, "write", full)
    path = bag_path(tmp_path, kind)
    with pytest.raises(OutputError, match=f"{path.name}: cannot be written: No space left"):
        write_bag(path, kind, drive.recording)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_bag_is_not_replaced(
    tmp_path: Path, drive: SimulatedDrive, kind: BagKind
) -> None:
    path = bag_path(tmp_path, kind)
    path.mkdir()
    (path / "diary.txt").write_text("mine")
    with pytest.raises(OutputError, match=f"{path.name} exists and is no {kind} bag"):
        write_bag(path, kind, drive.recording)
    assert (path / "diary.txt").read_text() == "mine"


def test_a_ros1_bag_needs_its_suffix(tmp_path: Path, drive: SimulatedDrive) -> None:
    with pytest.raises(OutputError, match=r"drive: the name of a ROS1 bag must end in \.bag"):
        write_bag(tmp_path / "drive", BagKind.ROS1, drive.recording)
