"""Clouds out of bags: scans of a moving, turning lidar become one cloud that stands still."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import BagError, MapError
from l2m_gtsam.storage import cloud
from l2m_gtsam.storage.bag_options import Stamps
from l2m_gtsam.storage.cloud import thinned_cloud
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, TopicCloud, read_cloud_topic
from tests.drives.bags import KINDS, Entry, ros, write
from tests.drives.clouds import PLAIN, SECOND, START, Layout, entries, field, scan
from tests.support.memory import with_peak

FINE = CloudTopicOptions(edge=0.01)


def drive(stamp_ns: Any) -> tuple[FloatArray, FloatArray]:
    """Rotations and positions of the lidar: constant speed and turn rate about a tilted axis."""
    t = (np.asarray(stamp_ns) - START) * 1e-9
    R = Rotation.from_rotvec(np.outer(t, [0.05, -0.1, 0.8])).as_matrix()
    return R, np.outer(t, [1.5, -0.5, 0.1]) + np.array([1.0, 2.0, 0.8])


def trajectory(seconds: float = 4.0, rate: float = 10.0) -> Trajectory:
    stamps = START + (np.arange(seconds * rate + 1) / rate * SECOND).astype(np.int64)
    R, p = drive(stamps)
    return Trajectory(stamps, R, p, "map", "lidar")


def hall(count: int = 60) -> FloatArray:
    """Points around the drive, one to a cell of 1 cm, in the middle of it, in the map."""
    rng = np.random.default_rng(5)
    cells = rng.choice(1000, size=(count, 3)) - 300
    return np.asarray((np.unique(cells, axis=0) + 0.5) * 0.01)


# Between poses, on one, and at the ends of the trajectory.
STAMPS = (START, START + 730_000_000, START + 1_500_000_000, START + 4 * SECOND)


def scans(kind: str, layout: Layout = PLAIN, stamps: Sequence[int] = STAMPS) -> list[Any]:
    """What the lidar saw of the hall at these times."""
    R, p = drive(stamps)
    return [scan(kind, stamp, (hall() - p[k]) @ R[k], layout) for k, stamp in enumerate(stamps)]


def read(
    path: Path, options: CloudTopicOptions = FINE, poses: Trajectory | None = None
) -> TopicCloud:
    return read_cloud_topic(path, "/points", trajectory() if poses is None else poses, options)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moving_lidar_sees_a_hall_that_stands_still(tmp_path: Path, kind: str) -> None:
    """Poses are exact between stamps: straight line and constant turn are what SE(3) gives."""
    found = read(write(tmp_path, kind, entries(scans(kind))))
    assert (found.scans, found.without_pose) == (len(STAMPS), 0)
    # float32 at 10 m.
    np.testing.assert_allclose(found.points, hall(), atol=2e-6)


@pytest.mark.parametrize(
    "layout",
    [
        Layout(kind="<f8"),
        Layout(kind=">f4"),
        Layout(kind=">f8", lead=3, tail=5),
        Layout(lead=4, tail=16),
        Layout(rows=4, row_tail=12, tail=1),
        Layout(names="zxy"),
    ],
)
def test_any_layout_gives_the_same_cloud(tmp_path: Path, layout: Layout) -> None:
    found = read(write(tmp_path, "mcap", entries(scans("mcap", layout))))
    np.testing.assert_allclose(found.points, hall(), atol=2e-6)


def test_row_step_of_a_single_row_does_not_matter(tmp_path: Path) -> None:
    content = scan("mcap", START, hall(), row_step=0)
    found = read(write(tmp_path, "mcap", entries([content])))
    assert len(found.points) == len(hall())


def test_scans_are_merged_as_one_cloud_would_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many scans with NaN and infinity in them, merged in small batches, against all at once."""
    rng = np.random.default_rng(7)
    stamps = [START + k * SECOND // 7 for k in range(1, 25)]
    R, p = drive(stamps)
    seen = [rng.uniform(-5, 5, (200, 3)) for _ in stamps]
    for each in seen:
        each[:4] = [[np.nan, 1, 1], [np.inf, 0, 0], [np.nan] * 3, [0, -np.inf, 2]]
    content = [scan("ros1", stamp, each) for stamp, each in zip(stamps, seen, strict=True)]
    monkeypatch.setattr(cloud, "BATCH_POINTS", 1000)
    options = CloudTopicOptions(edge=0.7, min_range=0)
    found = read(write(tmp_path, "ros1", entries(content)), options)
    placed = [
        each[4:].astype("<f4").astype(np.float64) @ R[k].T + p[k] for k, each in enumerate(seen)
    ]
    # Interpolated rotations, and sums in another order: rounding.
    np.testing.assert_allclose(
        found.points, thinned_cloud(np.concatenate(placed), 0.7), rtol=0, atol=1e-9
    )


def test_memory_follows_the_cells_and_not_the_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    stamps = [START + k * SECOND // 20 for k in range(60)]
    content = [scan("mcap", stamp, rng.uniform(-5, 5, (20_000, 3))) for stamp in stamps]
    path = write(tmp_path, "mcap", entries(content))
    monkeypatch.setattr(cloud, "BATCH_POINTS", 20_000)
    all_points = len(stamps) * 20_000 * 3 * 8
    read(path)  # imports and caches
    _, peak = with_peak(lambda: read(path, CloudTopicOptions(edge=1.0)))
    assert peak < 0.4 * all_points


def test_only_points_at_a_useful_distance_count(tmp_path: Path) -> None:
    """Spheres around the lidar; what is nearer is the vehicle, what is further does not matter."""
    rng = np.random.default_rng(9)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.repeat([0.3, 0.9, 1.1, 2.9, 3.1, 500.0], 50)
    path = write(tmp_path, "mcap", entries([scan("mcap", START, directions * radii[:, None])]))
    found = read(path, CloudTopicOptions(edge=0.01, min_range=1.0, max_range=3.0))
    ranges = np.linalg.norm(found.points - trajectory().p[0], axis=1)
    # Points that share a cell of 1 cm are merged to one a little further in.
    assert ((np.abs(ranges - 1.1) < 1e-3) | (np.abs(ranges - 2.9) < 1e-3)).all()
    assert 90 <= len(ranges) <= 100
    with pytest.raises(BagError, match=r"no scan has a finite point between 20 and 100 m"):
        read(path, CloudTopicOptions(min_range=20.0, max_range=100.0))
    with pytest.raises(ValidationError, match="less than"):
        CloudTopicOptions(min_range=2.0, max_range=2.0)


def test_scans_without_a_pose_are_skipped_and_counted(tmp_path: Path) -> None:
    poses = trajectory()
    keep = np.abs(poses.stamp_ns - START - 2 * SECOND) > 0.45 * SECOND  # 1 s without poses
    gappy = replace(poses, stamp_ns=poses.stamp_ns[keep], R=poses.R[keep], p=poses.p[keep])
    early, late, within = START - 1, START + 4 * SECOND + 1, START + 2 * SECOND
    stamps = [early, *STAMPS, within, late]
    path = write(tmp_path, "mcap", entries(scans("mcap", stamps=stamps)))
    found = read(path, poses=gappy)
    assert (found.scans, found.without_pose) == (len(STAMPS) + 3, 3)
    np.testing.assert_allclose(found.points, hall(), atol=2e-6)
    patient = read(path, CloudTopicOptions(edge=0.01, max_pose_gap_s=1.1), gappy)
    assert patient.without_pose == 2
    path = write(tmp_path, "mcap", entries(scans("mcap", stamps=[early, late])), "none")
    with pytest.raises(BagError, match=r"none of its 2 scans has a pose: poses run from 17"):
        read(path)
    with pytest.raises(BagError, match="no scans, or no poses"):
        read(path, poses=replace(poses, stamp_ns=poses.stamp_ns[:0]))


def test_record_times_can_count(tmp_path: Path) -> None:
    late = [stamp - SECOND // 50 for stamp in STAMPS[1:]]  # received at STAMPS
    R, p = drive(STAMPS[1:])
    content = [scan("mcap", stamp, (hall() - p[k]) @ R[k]) for k, stamp in enumerate(late)]
    path = write(tmp_path, "mcap", entries(content))
    found = read_cloud_topic(path, "points", trajectory(), FINE, Stamps.RECORD)
    np.testing.assert_allclose(found.points, hall(), atol=2e-6)


def test_topics_that_are_no_cloud(tmp_path: Path) -> None:
    make = ros("mcap")
    pose = Entry(
        "/pose",
        "geometry_msgs/PoseStamped",
        START,
        make.pose_stamped(START, [0, 0, 0], [0, 0, 0, 1]),
    )
    path = write(tmp_path, "mcap", [pose, *entries(scans("mcap"))])
    with pytest.raises(BagError, match=r"no topic '/cloud'; with clouds there are: /points"):
        read_cloud_topic(path, "/cloud", trajectory(), FINE)
    with pytest.raises(BagError, match=r"/pose is of type geometry_msgs/msg/PoseStamped"):
        read_cloud_topic(path, "/pose", trajectory(), FINE)


def refused(folder: Path, contents: list[Any]) -> str:
    """The one line about a bag of these scans."""
    path = write(folder, "mcap", entries(contents))
    with pytest.raises(BagError) as caught:
        read(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: topic /points: ")
    assert "\n" not in line
    return line


def test_frames_that_cannot_be_right(tmp_path: Path) -> None:
    header = ros("mcap").header
    mixed = [*scans("mcap"), scan("mcap", START, hall(), header=header(START, "lidar_2"))]
    assert "several frames (lidar, lidar_2)" in refused(tmp_path / "mixed", mixed)
    placed = [scan("mcap", START, hall(), header=header(START, "/map"))]
    assert "the frame of the map" in refused(tmp_path / "placed", placed)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 10_000}, "declares 1 x 10000 points"),
        ({"height": 4_000_000_000, "row_step": 0}, "declares 4000000000 x"),
        ({"height": 4_000_000_000, "width": 4_000_000_000}, "declares 4000000000 x 4000000000"),
        ({"point_step": 0}, "reaches over the end"),
        ({"point_step": 8}, "reaches over the end"),
        ({"data": np.zeros(5, np.uint8)}, "its 5 bytes are not"),
        ({"fields": []}, r"no field 'x' of one float; its fields are: \(none\)"),
        ({"fields": [field("x"), field("y", 4)]}, "no field 'z'"),
        ({"fields": [field("x", datatype=3), field("y"), field("z")]}, "no field 'x' of one float"),
        ({"fields": [field("x", count=2), field("y"), field("z")]}, "no field 'x' of one float"),
        ({"fields": [field("x", 4_000_000_000), field("y"), field("z")]}, "'x' reaches over"),
        ({"width": 0, "data": np.zeros(0, np.uint8)}, "no scan has a finite point"),
    ],
)
def test_scans_that_lie(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    assert re.search(reason, refused(tmp_path, [scan("mcap", START, hall(), **changes)]))


def test_poses_astray(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", entries(scans("mcap")))
    poses = trajectory()
    with pytest.raises(MapError, match=r"topic /points: has a coordinate of 1e\+09 m"):
        read(path, poses=replace(poses, p=poses.p + 1e9))
    jumping = replace(poses, p=poses.p + np.linspace(0, 5e4, len(poses))[:, None])
    with pytest.raises(BagError, match=r"points more than 1\.05e\+04 m apart"):
        read(path, poses=jumping)
