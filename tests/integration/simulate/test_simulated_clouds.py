"""Point clouds, drift and true poses in simulated bags, read back as a user's would be."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.bag_writer import BagKind, write_bag
from l2m_gtsam.simulate.lidar import SpinningLidarOptions
from l2m_gtsam.simulate.odometry import OdometryDriftOptions
from l2m_gtsam.simulate.recorder import SimulatedDrive
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.storage.bag import read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions as ReadOptions
from l2m_gtsam.storage.cloud import thinned_cloud
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, read_cloud_topic
from tests.support.memory import with_peak

SMALL: dict[str, Any] = {
    "floor_plan": {"length": 16.0, "width": 9.0, "rack_rows": 1, "blocks": 1},
    "suite": {"lateral": [0.0], "heights": [0.0]},
    "array": {"count": 1},
    "calibration_route": {"shape": "loop"},
    "mapping_sampling": {"field_rate": 1.0, "pose_rate": 2.0},
    "calibration_sampling": {"field_rate": 5.0, "pose_rate": 10.0},
}
COARSE = {"columns": 90, "rate": 1.0}
KINDS = list(BagKind)


@cache
def made(**more: str) -> Scenario:
    groups = {name: json.loads(entry) for name, entry in more.items()}
    return simulate(ScenarioOptions.model_validate({**SMALL, **groups}))


def plain() -> Scenario:
    return made()


def scanned() -> Scenario:
    return made(lidar=json.dumps(COARSE), odometry="{}")


def bag_path(folder: Path, kind: BagKind) -> Path:
    return folder / ("drive.bag" if kind is BagKind.ROS1 else f"drive_{kind}")


def written(folder: Path, kind: BagKind, drive: SimulatedDrive) -> Path:
    path = bag_path(folder, kind)
    write_bag(path, kind, drive.recording, scans=drive.scans, truth=drive.truth())
    return path


def messages(path: Path, topic: str) -> list[Any]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(chosen)]


def to_single(points: FloatArray) -> FloatArray:
    return points.astype("<f4").astype(np.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_the_reader_of_clouds_places_what_was_written(tmp_path: Path, kind: BagKind) -> None:
    drive = scanned().calibration
    assert drive.scans is not None
    path = written(tmp_path, kind, drive)
    truth = drive.motion.at(drive.scans.stamp_ns)
    options = CloudTopicOptions(edge=0.2, min_range=0.0, max_range=1000.0)
    found = read_cloud_topic(path, "points", truth, options)
    assert (found.scans, found.without_pose) == (len(drive.scans), 0)
    placed = [
        to_single(scan.points) @ R.T + p
        for scan, R, p in zip(drive.scans, truth.R, truth.p, strict=True)
    ]
    # Rotations are interpolated between poses and at them: rounding of 20 m.
    expected = thinned_cloud(np.concatenate(placed), 0.2)
    np.testing.assert_allclose(found.points, expected, rtol=0, atol=1e-9)
    hall = scanned().options.floor_plan
    inside = np.array([hall.length, hall.width, 8.6])
    # The hall's surfaces and what stands in it; five standard deviations of a range.
    assert found.points.min() > -0.05
    assert np.all(found.points.max(axis=0) < inside + 0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_points_of_a_sweep_have_their_times(tmp_path: Path, kind: BagKind) -> None:
    drive = made(lidar=json.dumps({**COARSE, "sweep": 0.1})).calibration
    assert drive.scans is not None
    cloud = messages(written(tmp_path, kind, drive), "/points")[3]
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "time"]
    assert cloud.header.frame_id == "lidar"
    table = np.frombuffer(bytes(cloud.data), "<f4").reshape(cloud.width, 4)
    scan = drive.scans[3]
    assert scan.time_s is not None
    np.testing.assert_array_equal(table[:, :3], scan.points.astype("<f4"))
    np.testing.assert_array_equal(table[:, 3], scan.time_s.astype("<f4"))


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_drifts_and_the_truth_stands_beside_it(tmp_path: Path, kind: BagKind) -> None:
    drive = scanned().calibration
    path = written(tmp_path, kind, drive)
    found, recorded = read_recording(path, ReadOptions()).trajectory, drive.recording.trajectory
    assert (found.frame, found.child_frame) == ("odom", "lidar")
    np.testing.assert_allclose(found.p, recorded.p, rtol=0, atol=0)
    assert found.covariance is not None
    assert recorded.covariance is not None
    # Rotated there and back: a few roundings of up to a square metre.
    np.testing.assert_allclose(found.covariance, recorded.covariance, rtol=0, atol=1e-14)
    truth = read_trajectory(path, ReadOptions(poses="/ground_truth"))
    assert truth.frame == "map"
    np.testing.assert_array_equal(truth.stamp_ns, found.stamp_ns)
    np.testing.assert_allclose(truth.p, drive.truth().p, rtol=0, atol=0)
    off = np.linalg.norm(truth.p - found.p, axis=1)
    way = np.linalg.norm(np.diff(truth.p, axis=0), axis=1).sum()
    assert off[0] < 0.02
    # A scale error of 1 % and walks of 10 cm and half a degree per 100 m: some percent at most.
    assert 0.001 * way < off.max() < 0.04 * way


def test_what_is_asked_for_changes_nothing_else() -> None:
    """Bit for bit: the same readings, mapping poses and motion, with clouds and drift and not."""
    for with_more, without in (
        (scanned().mapping, plain().mapping),
        (scanned().calibration, plain().calibration),
    ):
        for ours, theirs in zip(with_more.recording.series, without.recording.series, strict=True):
            assert ours.stamp_ns.tobytes() == theirs.stamp_ns.tobytes()
            assert ours.field.tobytes() == theirs.field.tobytes()
    assert scanned().mapping.recording.source == plain().mapping.recording.source
    assert scanned().calibration.recording.source != plain().calibration.recording.source
    assert scanned().cloud.tobytes() == plain().cloud.tobytes()
    assert plain().mapping.scans is None


def test_clouds_beside_a_recording_leave_its_messages_as_they_are(tmp_path: Path) -> None:
    recording = plain().mapping.recording
    alone, beside = tmp_path / "alone", tmp_path / "beside"
    write_bag(alone, BagKind.MCAP, recording)
    write_bag(beside, BagKind.MCAP, recording, scans=scanned().mapping.scans)

    def records(path: Path) -> list[tuple[str, int, bytes]]:
        with AnyReader([path]) as reader:
            chosen = [c for c in reader.connections if c.topic != "/points"]
            return [(c.topic, time, bytes(raw)) for c, time, raw in reader.messages(chosen)]

    assert records(alone) == records(beside)


def test_options_are_told_only_where_they_are_asked_for() -> None:
    groups = {"corridor", "lidar", "odometry"}
    assert not groups & set(ScenarioOptions().model_dump(mode="json"))
    options = ScenarioOptions(lidar=SpinningLidarOptions(), odometry=OdometryDriftOptions())
    told = options.model_dump(mode="json")
    assert told["lidar"]["beams"] == 32
    assert ScenarioOptions.model_validate(told) == options


def test_a_survey_of_its_own_has_scans_of_its_own() -> None:
    first, second = scanned().mapping, made(lidar=json.dumps(COARSE), survey_seed="7").mapping
    assert first.scans is not None
    assert second.scans is not None
    assert first.scans.seed != second.scans.seed


def test_scans_are_regular_and_lie_within_the_drive() -> None:
    drive = scanned().calibration
    assert drive.scans is not None
    seconds = (drive.scans.stamp_ns - drive.motion.start_ns) * 1e-9
    # Nanoseconds.
    np.testing.assert_allclose(np.diff(seconds), 1.0, rtol=0, atol=2e-9)
    assert 0 <= seconds[0] < 1.0
    assert drive.motion.duration - 1.0 < seconds[-1] <= drive.motion.duration


@pytest.mark.parametrize("kind", KINDS)
def test_scans_are_written_one_by_one(tmp_path: Path, kind: BagKind) -> None:
    drive = made(lidar=json.dumps({"columns": 450, "rate": 1.0})).calibration
    assert drive.scans is not None
    size = sum(12 * len(scan) for scan in drive.scans)
    _, peak = with_peak(lambda: written(tmp_path, kind, drive))
    assert size > 7.5e6
    # A scan of 15,000 rays in double precision, several times over, and buffers of the writer.
    assert peak < 6e6
