"""Copies of bags with corrected readings: what they keep, and where they are written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import (
    ConnectionExtRosbag2,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import get_types_from_msg

from l2m_gtsam.errors import BagError, OutputError
from l2m_gtsam.storage import calibrated_topics
from tests.drives.bag_copies import START, VERDICT, applied, connections, content, entries, readings
from tests.drives.bags import KINDS, ros, write

LATCHED = Qos(
    QosHistory.KEEP_LAST,
    7,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    QosTime(1, 2),
    QosTime(3, 4),
    QosLiveliness.AUTOMATIC,
    QosTime(5, 6),
    avoid_ros_namespace_conventions=False,
)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_said_of_topics_is_kept(kind: str, tmp_path: Path) -> None:
    bag = write(tmp_path, kind, entries(kind, readings()))
    applied(tmp_path, bag)
    before = connections(bag)
    after = connections(tmp_path / ("out.bag" if kind == "ros1" else "out"))
    assert after.pop("/imu/mag/calibrated") == before["/imu/mag"]
    text, *_, extra = after.pop(VERDICT)
    assert text == "std_msgs/msg/String"
    if kind == "ros1":
        assert extra.latching == 1
    else:
        (kept,) = extra.offered_qos_profiles
        assert kept.durability is QosDurability.TRANSIENT_LOCAL
    assert after == before


def test_the_originals_can_be_left_out(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", entries("mcap", readings()))
    applied(tmp_path, bag, replace=True)
    assert set(content(tmp_path / "out")) == {"/imu/mag/calibrated", "/pose", "/note", VERDICT}


def test_one_file_stays_one_file(tmp_path: Path) -> None:
    for kind, suffix in (("mcap", ".mcap"), ("sqlite3", ".db3")):
        (file,) = write(tmp_path, kind, entries(kind, readings()), kind).glob(f"*{suffix}")
        out = tmp_path / f"one{suffix}"
        applied(tmp_path, file, out=out)
        assert out.is_file()
        assert len(content(out)["/imu/mag/calibrated"]) == 30
    with pytest.raises(OutputError, match=r"its name must end in \.db3 or be that of a folder"):
        applied(tmp_path, file, out=tmp_path / "two.mcap")
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        "calibration.yaml",
        "mcap",
        "one.db3",
        "one.mcap",
        "sqlite3",
    ]


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE, "chunks"])
def test_ros2_compression_is_kept(mode: CompressionMode | str, tmp_path: Path) -> None:
    chunks = mode == "chunks"
    plugin = StoragePlugin.MCAP if chunks else StoragePlugin.SQLITE3
    writer = Ros2Writer(tmp_path / "bag", version=9, storage_plugin=plugin)
    used = CompressionMode.STORAGE if isinstance(mode, str) else mode
    writer.set_compression(used, CompressionFormat.ZSTD)
    writer.set_custom_data("driver", "north")
    fill_ros2(writer)
    applied(tmp_path, tmp_path / "bag")
    assert content(tmp_path / "out")["/imu/mag"] == content(tmp_path / "bag")["/imu/mag"]
    with Ros2Reader(tmp_path / "out") as reader, Ros2Reader(tmp_path / "bag") as source:
        assert reader.compression_mode == source.compression_mode
        assert reader.storage.metadata.custom == {"driver": "north"}
    if chunks:
        (file,) = (tmp_path / "out").glob("*.mcap")
        with Ros2Reader(file) as reader:
            assert {chunk.compression for chunk in reader.storage.chunks} == {"zstd"}  # type: ignore[attr-defined]


@pytest.mark.parametrize("compression", list(Ros1Writer.CompressionFormat))
def test_ros1_compression_and_callers_are_kept(compression: Any, tmp_path: Path) -> None:
    """A node that came back has a second connection with the same name: both become one."""
    store, make = ros("ros1").store, ros("ros1")
    path = tmp_path / "bag.bag"
    writer = Ros1Writer(path)
    writer.set_compression(compression)
    with writer:
        kind = "sensor_msgs/msg/MagneticField"
        topics = [
            writer.add_connection("/imu/mag", kind, typestore=store, callerid=who, latching=1)
            for who in ("/driver", "/other")
        ]
        for k, row in enumerate(readings(40) * 1e-6):
            raw = store.serialize_ros1(make.magnetic(START + k, row), kind)
            writer.write(topics[k % 2], START + k, raw)
    applied(tmp_path, path)
    with Ros1Reader(tmp_path / "out.bag") as reader:
        found = {(c.topic, *c.ext) for c in reader.connections}
        used = {chunk.decompressor for chunk in reader.chunks.values()}
    found.remove((VERDICT, None, 1))
    assert found == {
        (topic, who, 1)
        for topic in ("/imu/mag", "/imu/mag/calibrated")
        for who in ("/driver", "/other")
    }
    with Ros1Reader(path) as reader:
        assert used == {chunk.decompressor for chunk in reader.chunks.values()}


def fill_ros2(writer: Ros2Writer) -> None:
    """Write readings, and a latched topic of a type that nobody knows."""
    store = ros("mcap").store
    store.register(get_types_from_msg("float64 volts\nint8[] raw", "own_msgs/msg/Battery"))
    kind, own = "sensor_msgs/msg/MagneticField", "own_msgs/msg/Battery"
    with writer:
        mag = writer.add_connection("/imu/mag", kind, typestore=store)
        battery = writer.add_connection(
            "/battery", own, typestore=store, offered_qos_profiles=[LATCHED]
        )
        for k, row in enumerate(readings() * 1e-6):
            raw = store.serialize_cdr(ros("mcap").magnetic(START + k, row), kind)
            writer.write(mag, START + k, raw)
            told = store.types[own](volts=12.0 + k, raw=np.arange(k % 5, dtype=np.int8))
            writer.write(battery, START + k, store.serialize_cdr(told, own))


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_foreign_types_and_their_quality_of_service_are_kept(kind: str, tmp_path: Path) -> None:
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    fill_ros2(Ros2Writer(tmp_path / "bag", version=9, storage_plugin=plugin))
    applied(tmp_path, tmp_path / "bag")
    assert connections(tmp_path / "out")["/battery"] == connections(tmp_path / "bag")["/battery"]
    ext = connections(tmp_path / "out")["/battery"][3]
    assert isinstance(ext, ConnectionExtRosbag2)
    assert ext.offered_qos_profiles == [LATCHED]
    assert content(tmp_path / "out")["/battery"] == content(tmp_path / "bag")["/battery"]


def test_a_type_without_a_definition_is_copied(tmp_path: Path) -> None:
    """Bags of humble and before have none in sqlite3."""
    writer = Ros2Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP)
    store = ros("mcap").store
    kind = "sensor_msgs/msg/MagneticField"
    with writer:
        mag = writer.add_connection("/imu/mag", kind, msgdef="", rihs01="x")
        odd = writer.add_connection("/odd", "own_msgs/msg/Odd", msgdef="", rihs01="x")
        for k, row in enumerate(readings() * 1e-6):
            raw = store.serialize_cdr(ros("mcap").magnetic(START + k, row), kind)
            writer.write(mag, START + k, raw)
            writer.write(odd, START + k, b"\x00\x01\x00\x00odd!")
    applied(tmp_path, tmp_path / "bag")
    assert content(tmp_path / "out")["/odd"] == content(tmp_path / "bag")["/odd"]
    assert len(content(tmp_path / "out")["/imu/mag/calibrated"]) == 30


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("ros1", "bag.bag", "bag.bag: exists already; choose another --out"),
        ("mcap", "bag", "bag: exists already; choose another --out"),
        ("ros1", "x", "x: the name of a ROS1 bag must end in .bag"),
        ("mcap", "x.bag", "x.bag: the name of a ROS2 bag must not end in .bag"),
        ("mcap", "calibration.yaml/x", "cannot be written"),
    ],
)
def test_a_place_that_cannot_be_written(kind: str, name: str, message: str, tmp_path: Path) -> None:
    bag = write(tmp_path, kind, entries(kind, readings()))
    before = content(bag)
    with pytest.raises(OutputError) as error:
        applied(tmp_path, bag, out=tmp_path / name)
    assert message in str(error.value)
    assert content(bag) == before
    assert {each.name for each in tmp_path.iterdir()} == {bag.name, "calibration.yaml"}


def test_nothing_is_left_of_a_copy_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise BagError("the bag ends here")

    monkeypatch.setattr(calibrated_topics.Calibrator, "_corrections", broken)
    for kind in KINDS:
        bag = write(tmp_path, kind, entries(kind, readings()), kind)
        with pytest.raises(BagError, match="ends here"):
            applied(tmp_path, bag)
    found = sorted(each.name for each in tmp_path.iterdir())
    assert found == ["calibration.yaml", "mcap", "ros1.bag", "sqlite3"]


def test_a_bag_is_not_corrected_twice(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", entries("mcap", readings()))
    applied(tmp_path, bag)
    with pytest.raises(BagError, match="has a topic /imu/mag/calibrated already"):
        applied(tmp_path, tmp_path / "out", out=tmp_path / "twice")
