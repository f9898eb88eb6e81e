"""Scans out of bags one by one: points, their times as drivers write them, and what is wrong."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.records.scans import Scan, ScanOptions
from l2m_gtsam.storage.bag_options import Stamps
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, read_cloud_topic
from l2m_gtsam.storage.point_cloud2 import ScanTopic, cloud_topic, has_clouds
from tests.drives.bags import KINDS, Entry, ros, write
from tests.drives.clouds import SECOND, START, TYPE, entries, field, scan
from tests.support.memory import with_peak

NEAR = ScanOptions(min_range=0.0, max_range=50.0)
POINTS: FloatArray = np.random.default_rng(0).uniform(-5, 5, (40, 3))
TENTH: FloatArray = np.linspace(0.0, 0.1, 40)


def read(path: Path, options: ScanOptions = NEAR, topic: str | None = None) -> list[Scan]:
    return list(ScanTopic(path, topic, options))


@dataclass(frozen=True)
class Clock:
    """How a driver writes the time of a point."""

    name: str
    datatype: int
    kind: str
    of: Any


CLOCKS = {
    "velodyne": Clock("time", 7, "<f4", lambda s: s),
    "ouster": Clock("t", 6, "<u4", lambda s: s * 1e9),
    "hesai": Clock("timestamp", 8, "<f8", lambda s: START * 1e-9 + s),
    "livox": Clock("timestamp", 8, "<f8", lambda s: START + s * 1e9),
    "livox_offset": Clock("offset_time", 6, "<u4", lambda s: s * 1e9),
    "signed": Clock("time_stamp", 5, "<i4", lambda s: -s * 1e9),
}


def timed(clock: Clock, points: FloatArray, seconds: FloatArray, stamp_ns: int = START) -> Any:
    """A scan with a time beside each point."""
    size = np.dtype(clock.kind).itemsize
    layout = np.dtype([("p", "<f4", 3), ("t", clock.kind)])
    data = np.zeros(len(points), layout)
    data["p"], data["t"] = points, clock.of(seconds)
    fields = [field(n, 4 * k, kind="mcap") for k, n in enumerate("xyz")]
    return scan(
        "mcap",
        stamp_ns,
        points,
        fields=[*fields, field(clock.name, 12, clock.datatype, kind="mcap")],
        point_step=12 + size,
        row_step=(12 + size) * len(points),
        data=data.view(np.uint8),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_scans_come_one_by_one(tmp_path: Path, kind: str) -> None:
    stamps = [START + k * SECOND // 10 for k in range(4)]
    path = write(tmp_path, kind, entries([scan(kind, stamp, POINTS) for stamp in stamps]))
    found = read(path)
    assert [each.stamp_ns for each in found] == stamps
    for each in found:
        np.testing.assert_allclose(each.points, POINTS, atol=1e-6)  # float32
        assert each.time_s is None


@pytest.mark.parametrize("driver", CLOCKS)
def test_times_of_points_as_drivers_write_them(tmp_path: Path, driver: str) -> None:
    clock = CLOCKS[driver]
    path = write(tmp_path, "mcap", entries([timed(clock, POINTS, TENTH)]))
    (found,) = read(path)
    assert found.time_s is not None
    expected = -TENTH if driver == "signed" else TENTH
    # Seconds since 1970 as float64 have steps of 0.24 us.
    np.testing.assert_allclose(found.time_s, expected, atol=3e-7)


def test_times_that_are_not_of_the_scan_are_left_alone(tmp_path: Path) -> None:
    """A lidar's time since it was switched on: nobody knows when that was."""
    path = write(tmp_path, "mcap", entries([timed(CLOCKS["velodyne"], POINTS, TENTH + 77.0)]))
    (found,) = read(path)
    assert found.time_s is None


def test_points_out_of_range_go_with_their_times(tmp_path: Path) -> None:
    points = np.array([[1.0, 0, 0], [0.1, 0, 0], [np.nan, 0, 0], [0, 40, 0], [0, 0, 3]])
    seconds: FloatArray = 0.01 * np.arange(5.0)
    path = write(tmp_path, "mcap", entries([timed(CLOCKS["velodyne"], points, seconds)]))
    (found,) = read(path, ScanOptions(min_range=0.5, max_range=30.0))
    np.testing.assert_allclose(found.points, [[1, 0, 0], [0, 0, 3]])
    assert found.time_s is not None
    np.testing.assert_allclose(found.time_s, [0.0, 0.04])


def test_scans_that_go_back_in_time_are_left_out(tmp_path: Path) -> None:
    tenth = SECOND // 10
    given = [scan("mcap", START + k * tenth, POINTS) for k in (0, 2, 1, 2, 3)]
    records = [Entry("/points", TYPE, START + k * tenth, each) for k, each in enumerate(given)]
    path = write(tmp_path, "mcap", records)
    assert [(s.stamp_ns - START) // tenth for s in read(path)] == [0, 2, 3]
    recorded = ScanTopic(path, None, NEAR, Stamps.RECORD)
    assert [(s.stamp_ns - START) // tenth for s in recorded] == [0, 1, 2, 3, 4]


def broken(**changes: Any) -> Any:
    return scan("mcap", START, POINTS, **changes)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (broken(width=10**6), "which its"),
        (broken(fields=[field("x", kind="mcap")]), "no field 'y'"),
        (
            broken(
                fields=[
                    *(field(n, 4 * k, kind="mcap") for k, n in enumerate("xyz")),
                    field("time", 10, kind="mcap"),
                ]
            ),
            "field 'time' reaches over the end",
        ),
    ],
    ids=["short", "no_y", "time_outside"],
)
def test_a_corrupt_scan_is_named(tmp_path: Path, content: Any, words: str) -> None:
    good = scan("mcap", START - SECOND, POINTS)
    path = write(tmp_path, "mcap", entries([good, content]))
    scans = iter(ScanTopic(path, None, NEAR))
    assert len(next(scans)) == len(POINTS)
    with pytest.raises(BagError, match=words) as error:
        next(scans)
    assert str(path) in str(error.value)
    assert "/points" in str(error.value)


def test_the_topic_is_the_only_one_or_named(tmp_path: Path) -> None:
    one = entries([scan("mcap", START, POINTS)], "/left")
    both = [*one, *entries([scan("mcap", START, POINTS[:9])], "/right")]
    path = write(tmp_path, "mcap", both)
    with pytest.raises(BagError, match=r"choose one with `lidar.topic`: /left, /right"):
        read(path)
    assert len(read(path, topic="right")[0]) == 9
    assert cloud_topic(path, "right") == "/right"
    with pytest.raises(BagError, match="no topic '/front'"):
        read(path, topic="/front")
    message = ros("mcap").magnetic(START, (0, 0, 0))
    bare = write(
        tmp_path, "mcap", [Entry("/mag", "sensor_msgs/MagneticField", START, message)], "bare"
    )
    assert (has_clouds(path), has_clouds(bare)) == (True, False)
    with pytest.raises(BagError, match="no topic of type sensor_msgs/msg/PointCloud2"):
        read(bare)


def test_scans_of_several_frames_are_refused(tmp_path: Path) -> None:
    header = ros("mcap").header(START + SECOND, "other")
    given = [scan("mcap", START, POINTS), scan("mcap", START + SECOND, POINTS, header=header)]
    path = write(tmp_path, "mcap", entries(given))
    with pytest.raises(BagError, match="several frames"):
        read(path)


def test_one_scan_is_in_memory_at_a_time(tmp_path: Path) -> None:
    """Thirty scans of 1.2 MB, whose points are 72 MB as float64."""
    many = np.random.default_rng(1).uniform(1, 5, (100_000, 3))
    given = (scan("mcap", START + k * SECOND, many) for k in range(30))
    path = write(tmp_path, "mcap", entries(given))
    next(iter(ScanTopic(path, None, NEAR)))  # what reading itself keeps
    count, peak = with_peak(lambda: sum(1 for _ in ScanTopic(path, None, NEAR)))
    assert count == 30
    # Message, columns, points, masks and the points of the scan before.
    assert peak < 20e6


def test_swept_scans_of_a_mapping_drive_are_brought_to_their_stamps(tmp_path: Path) -> None:
    """A lidar that turns and moves: each point is where it was at its own time."""
    stamps = START + np.arange(11) * SECOND // 10
    t = (stamps - START) * 1e-9
    v, w = np.array([1.5, 0.0, 0.0]), np.array([0.0, 0.0, 0.8])
    poses = Trajectory(
        stamps, Rotation.from_rotvec(np.outer(t, w)).as_matrix(), np.outer(t, v), "map", "lidar"
    )
    hall = (np.round(POINTS / 0.02) + 0.5) * 0.02
    R = Rotation.from_rotvec(np.outer(0.2 + TENTH, w)).as_matrix()
    seen = np.einsum("nji,nj->ni", R, hall - np.outer(0.2 + TENTH, v))
    given = timed(CLOCKS["ouster"], seen, TENTH, int(stamps[2]))
    path = write(tmp_path, "mcap", entries([given]))
    found = read_cloud_topic(path, "/points", poses, CloudTopicOptions(edge=0.02, min_range=0.0))
    # The scan's motion counts as that of a constant twist: 1.5 m/s and 0.8 rad/s over 0.1 s bend
    # the way by 6 mm, of which half is left at worst.
    distance = np.linalg.norm(found.points[:, None] - hall, axis=2).min(axis=1)
    assert np.max(distance) < 0.007
    assert len(found.points) == len(hall)


def test_a_driver_that_leaves_times_empty_takes_snapshots(tmp_path: Path) -> None:
    seconds = np.zeros(len(POINTS))
    seconds[3] = np.nan
    path = write(tmp_path, "mcap", entries([timed(CLOCKS["velodyne"], POINTS, seconds)]))
    poses = Trajectory(
        np.array([START, START + SECOND]),
        np.stack([np.eye(3)] * 2),
        np.zeros((2, 3)),
        "map",
        "lidar",
    )
    found = read_cloud_topic(path, "/points", poses, CloudTopicOptions(edge=0.01, min_range=0.0))
    assert (found.without_pose, len(found.points)) == (0, len(POINTS))


def test_ranges_must_leave_room() -> None:
    with pytest.raises(ValidationError, match="`min_range` must be less"):
        ScanOptions(min_range=30.0)
