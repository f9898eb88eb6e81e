"""Bags that carry more than one thing where one is expected, or less than they promise."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from rosbags.rosbag2 import StoragePlugin, Writer

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag import read_fields, read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions, TfChain
from l2m_gtsam.storage.inspect import inspect_bag
from tests.drives.bags import KINDS, Entry, ros, write
from tests.support.memory import with_peak

START = 1_700_000_000_000_000_000
STEP = 100_000_000
COUNT = 30
EARTH = np.array([20e-6, 5e-6, -40e-6])
UNIT = [0, 0, 0, 1]
FIELD, POSE = "sensor_msgs/MagneticField", "geometry_msgs/PoseStamped"


def each(make_entry: Callable[[int, int], Entry], count: int = COUNT) -> list[Entry]:
    """Return one entry per index and stamp."""
    return [make_entry(k, START + k * STEP) for k in range(count)]


def poses(kind: str) -> list[Entry]:
    make = ros(kind)
    return each(lambda k, t: Entry("/pose", POSE, t, make.pose_stamped(t, [k, 0, 0], UNIT)))


def mag(kind: str, topic: str, frame: str, later: int = 0, count: int = COUNT) -> list[Entry]:
    make = ros(kind)

    def entry(k: int, stamp: int) -> Entry:
        reading = make.magnetic(stamp + later, EARTH * (1 + k / 1000), frame)
        return Entry(topic, FIELD, stamp + later, reading)

    return each(entry, count)


def bag(folder: Path, kind: str, *parts: list[Entry]) -> Path:
    entries = [entry for part in parts for entry in part]
    return write(folder, kind, sorted(entries, key=lambda entry: entry.record_ns))


@pytest.mark.parametrize("kind", KINDS)
def test_two_sensors_on_one_topic_are_never_mixed(tmp_path: Path, kind: str) -> None:
    mixed = mag(kind, "/mags", "left"), mag(kind, "/mags", "right", 1000)
    path = bag(tmp_path, kind, poses(kind), *mixed)
    with pytest.raises(BagError, match=r"/mags .*several frames \(left, right\).*split_by_frame"):
        read_recording(path, BagOptions())
    (report,) = (t for t in inspect_bag(path, BagOptions()).topics if t.topic == "/mags")
    assert report.use.startswith("refused: /mags carries readings in several frames")
    series = read_recording(path, BagOptions(split_by_frame=True)).series
    assert [(s.sensor, len(s)) for s in series] == [("left", COUNT), ("right", COUNT)]


def test_a_frame_that_two_topics_share_does_not_merge_them(tmp_path: Path) -> None:
    path = bag(tmp_path, "mcap", mag("mcap", "/x", "imu"), mag("mcap", "/y", "imu", 1000))
    series = read_fields(path, BagOptions(split_by_frame=True))
    assert [(s.sensor, len(s)) for s in series] == [("x/imu", COUNT), ("y/imu", COUNT)]


def test_two_bodies_on_one_pose_topic_are_never_mixed(tmp_path: Path) -> None:
    make = ros("mcap")

    def body(child: str, later: int) -> list[Entry]:
        def entry(k: int, stamp: int) -> Entry:
            pose = make.transform(stamp + later, "world", child, [k, 0, 0], UNIT)
            return Entry("/vicon", "geometry_msgs/TransformStamped", stamp + later, pose)

        return each(entry)

    path = bag(tmp_path, "mcap", body("robot", 0), body("wand", 1000))
    both = "a topic must track one body, this tracks: world > robot, world > wand"
    with pytest.raises(BagError, match=f": {both}$"):
        read_trajectory(path, BagOptions())
    (report,) = inspect_bag(path, BagOptions()).topics
    assert report.use == f"refused: {both}"


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0, 0.0], [np.nan] * 4])
def test_a_fault_beside_the_tf_chain_does_not_matter(tmp_path: Path, bad: list[float]) -> None:
    make = ros("ros1")

    def entry(k: int, stamp: int) -> Entry:
        links = [
            make.transform(stamp, "map", "base", [k, 0, 0], UNIT),
            make.transform(stamp, "base", "wheel", [0, 0, 0], bad),
        ]
        message = make("tf2_msgs/TFMessage", transforms=links)
        return Entry("/tf", "tf2_msgs/TFMessage", stamp, message)

    path = bag(tmp_path, "ros1", each(entry))
    chain = TfChain(frame="/map", child_frame="/base")  # ROS1 wrote frames with a slash
    assert len(read_trajectory(path, BagOptions(tf=chain))) == COUNT
    with pytest.raises(BagError, match=r"all zero|no pose is finite"):
        read_trajectory(path, BagOptions(tf=TfChain(frame="map", child_frame="wheel")))


def test_poses_and_tf_exclude_each_other() -> None:
    with pytest.raises(ValidationError, match="`poses` or `tf`, not both"):
        BagOptions(poses="/pose", tf=TfChain(frame="map", child_frame="base"))


def test_a_silent_topic_is_a_dead_sensor_among_others(tmp_path: Path) -> None:
    make, path = ros("mcap"), tmp_path / "silent"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        full = FIELD.replace("/", "/msg/")
        alive = writer.add_connection("/alive", full, typestore=make.store)
        writer.add_connection("/dead", full, typestore=make.store)
        for entry in mag("mcap", "/alive", "a"):
            data = make.store.serialize_cdr(entry.message, full)
            writer.write(alive, entry.record_ns, data)
    series = read_fields(path, BagOptions())
    assert [(s.sensor, len(s)) for s in series] == [("alive", COUNT), ("dead", 0)]
    assert series[1].field.shape == (0, 3)


def change(path: Path, statement: str, *values: object) -> None:
    """Change a sqlite3 bag behind its back."""
    with closing(sqlite3.connect(path / f"{path.name}.db3")) as database, database:
        assert database.execute(statement, values).rowcount > 0


def test_definitions_of_other_topics_do_not_matter(tmp_path: Path) -> None:
    text = ros("sqlite3")("std_msgs/String", data="x")
    odd = [Entry("/odd", "std_msgs/String", START, text)]
    path = bag(tmp_path, "sqlite3", poses("sqlite3"), mag("sqlite3", "/m", "a"), odd)
    nonsense = "UPDATE message_definitions SET encoded_message_definition = '@ nonsense' "
    change(path, nonsense + "WHERE topic_type LIKE 'std_msgs%'")
    assert len(read_recording(path, BagOptions()).series[0]) == COUNT
    change(path, nonsense + "WHERE topic_type LIKE 'sensor_msgs%'")
    with pytest.raises(BagError, match=r"definition of sensor_msgs/msg/MagneticField on /m"):
        read_recording(path, BagOptions())


@pytest.mark.parametrize("missing", ["%", "sensor_msgs%"])
def test_missing_definitions_are_those_of_ros(tmp_path: Path, missing: str) -> None:
    """None at all, or only some."""
    path = bag(tmp_path, "sqlite3", poses("sqlite3"), mag("sqlite3", "/m", "a"))
    before = read_recording(path, BagOptions())
    change(path, "DELETE FROM message_definitions WHERE topic_type LIKE ?", missing)
    after = read_recording(path, BagOptions())
    np.testing.assert_array_equal(after.series[0].field, before.series[0].field)
    np.testing.assert_array_equal(after.trajectory.p, before.trajectory.p)


def test_a_bag_that_holds_less_than_it_promises(tmp_path: Path) -> None:
    path = bag(tmp_path, "sqlite3", poses("sqlite3"), mag("sqlite3", "/m", "a"))
    change(path, "DELETE FROM messages WHERE id > ?", COUNT)
    with pytest.raises(BagError, match=r"truncated: its index promises 60 .*, 30 are there"):
        read_recording(path, BagOptions())


def test_memory_does_not_grow_with_point_clouds_in_ros1(tmp_path: Path) -> None:
    """60 MB of clouds: the reader must stay under a third of that, which is a few chunks."""
    make = ros("ros1")
    points = np.random.default_rng(0).integers(0, 255, 2_000_000, dtype=np.uint8)

    def cloud(k: int, stamp: int) -> Entry:
        message = make(
            "sensor_msgs/PointCloud2",
            header=make.header(stamp, "lidar"),
            height=1,
            width=125_000,
            fields=[],
            is_bigendian=False,
            point_step=16,
            row_step=2_000_000,
            data=points,
            is_dense=True,
        )
        return Entry("/points", "sensor_msgs/PointCloud2", stamp + 1, message)

    path = bag(tmp_path, "ros1", poses("ros1"), mag("ros1", "/m", "a"), each(cloud))
    assert path.stat().st_size > 60_000_000
    for work in (read_recording, inspect_bag):
        _, peak = with_peak(partial(work, path, BagOptions()))
        assert peak < 20e6


def test_progress_ends_at_the_total(tmp_path: Path) -> None:
    path = bag(tmp_path, "mcap", poses("mcap"), mag("mcap", "/m", "a", count=5000))
    seen: list[tuple[int, int]] = []
    read_recording(path, BagOptions(), lambda done, total: seen.append((done, total)))
    assert seen == sorted(seen)
    assert seen[-1] == (COUNT + 5000, COUNT + 5000)
