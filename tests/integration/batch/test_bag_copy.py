"""Bags copied with corrected readings, of every kind."""

from collections import defaultdict
from dataclasses import replace
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

from l2m_gtsam.batch.exports import Application, Applied, apply_calibration
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import BagError, CalibrationError, ConfigError, L2MError, OutputError
from l2m_gtsam.records.calibration import CalibrationResult, SensorStatus
from l2m_gtsam.records.sensor_models import MovingField
from l2m_gtsam.records.verdict import Judgement, Verdict
from l2m_gtsam.storage import calibrated_topics
from l2m_gtsam.storage.bag import read_fields
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.calibration_file import write_calibration
from tests.drives.bags import KINDS, Entry, ros, write
from tests.drives.calibrations import calibration, sensor, unsolved

START = 1_700_000_000_000_000_000
STEP = 10_000_000
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
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


GOOD = Judgement(Verdict.of([], []), {})
VERDICT = "/l2m/verdict"


def silent(_stage: str, _share: float) -> None:
    """Take no notice of progress."""


def readings(count: int = 30) -> FloatArray:
    """Return what the sensor of `made` reads, uT, shape (N, 3)."""
    return 20 + np.random.default_rng(0).normal(0, 10, (count, 3))


def made(**changes: Any) -> CalibrationResult:
    return calibration(sensor("imu/mag", TURN, np.diag([1.1, 0.9, 1.0]), **changes))


def entries(kind: str, field_ut: FloatArray, per_tesla: float = 1e-6) -> list[Entry]:
    """Readings with poses and text between them, two of which have one time."""
    make, found = ros(kind), []
    for k, row in enumerate(field_ut):
        stamp = START + k * STEP
        reading = make.magnetic(stamp, row * per_tesla, "mag_link")
        pose = make.pose_stamped(stamp, [k, 0, 0], [0, 0, 0, 1])
        found += [
            Entry("/imu/mag", "sensor_msgs/MagneticField", stamp + 2, reading),
            Entry("/pose", "geometry_msgs/PoseStamped", stamp + 2, pose),
            Entry("/note", "std_msgs/String", stamp + 5, make("std_msgs/String", data=f"{k}")),
        ]
    return found


def applied(
    folder: Path, bag: Path, result: CalibrationResult | None = None, **changes: Any
) -> Applied:
    """Apply a calibration, one without doubts if it was not judged, which gives `folder / out`."""
    path, given = folder / "calibration.yaml", made() if result is None else result
    write_calibration(path, replace(given, judgement=given.judgement or GOOD))
    out = folder / ("out.bag" if bag.suffix == ".bag" else "out")
    return apply_calibration(replace(Application(bag, path, out), **changes), silent)


def content(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return times and bytes of all messages by topic, in their order."""
    found = defaultdict(list)
    reader: Any = Ros1Reader(path) if path.suffix == ".bag" else Ros2Reader(path)
    with reader:
        for connection, stamp, raw in reader.messages():
            found[connection.topic].append((stamp, bytes(raw)))
    return found


def connections(path: Path) -> dict[str, tuple[Any, ...]]:
    """Return what is said of each topic."""
    reader: Any = Ros1Reader(path) if path.suffix == ".bag" else Ros2Reader(path)
    with reader:
        return {c.topic: (c.msgtype, c.msgdef, c.digest, c.ext) for c in reader.connections}


def calibrated(path: Path, topic: str = "/imu/mag/calibrated") -> Any:
    """Return the corrected readings of a bag."""
    (series,) = read_fields(path, BagOptions(fields=(topic,)))
    return series


@pytest.mark.parametrize("kind", KINDS)
def test_readings_are_corrected_beside_their_own(kind: str, tmp_path: Path) -> None:
    z = readings()
    bag = write(tmp_path, kind, entries(kind, z))
    done = applied(tmp_path, bag, lidar_frame="velodyne")
    assert done.topics == {"imu/mag": "/imu/mag/calibrated"}
    assert done.notes == ()
    out = tmp_path / ("out.bag" if kind == "ros1" else "out")
    before, after = content(bag), content(out)
    added = after.pop("/imu/mag/calibrated")
    ((first, _),) = after.pop(VERDICT)
    assert first == min(stamp for stamp, _ in before["/imu/mag"])
    assert after == before
    assert [stamp for stamp, _ in added] == [stamp for stamp, _ in before["/imu/mag"]]
    series = calibrated(out)
    C = TURN @ np.diag([1.1, 0.9, 1.0])
    # 30 uT at a condition of 1.2, in double precision
    expected = (z - [3.0, -2.0, 7.0]) @ np.linalg.inv(C).T
    np.testing.assert_allclose(series.field, expected, rtol=0, atol=1e-12)
    assert series.frame == "velodyne"
    np.testing.assert_array_equal(series.stamp_ns, START + STEP * np.arange(len(z)))


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


@pytest.mark.parametrize("kind", KINDS)
def test_the_covariance_is_in_square_tesla(kind: str, tmp_path: Path) -> None:
    """Noise of 0.2 uT and no error of C and H: sigma^2 inv(C) inv(C)^T."""
    bag = write(tmp_path, kind, entries(kind, readings(5)))
    applied(tmp_path, bag, made(covariance=np.zeros((15, 15)), time_offset=None))
    store = ros(kind).store
    out = tmp_path / ("out.bag" if kind == "ros1" else "out")
    for _, raw in content(out)["/imu/mag/calibrated"]:
        decode = store.deserialize_ros1 if kind == "ros1" else store.deserialize_cdr
        message: Any = decode(raw, "sensor_msgs/msg/MagneticField")
        found = message.magnetic_field_covariance.reshape(3, 3)
        expected = 4e-14 * np.diag([1 / 1.1**2, 1 / 0.9**2, 1.0])
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-27)


def test_a_missing_axis_is_not_known_and_its_covariance_neither(tmp_path: Path) -> None:
    z = readings(4)
    z[1, 2] = np.nan
    bag = write(tmp_path, "mcap", entries("mcap", z))
    applied(tmp_path, bag)
    np.testing.assert_array_equal(
        np.isfinite(calibrated(tmp_path / "out").field), np.tile([[1], [0], [1], [1]], (1, 3))
    )
    raw = content(tmp_path / "out")["/imu/mag/calibrated"][1][1]
    message: Any = ros("mcap").store.deserialize_cdr(raw, "sensor_msgs/msg/MagneticField")
    assert not message.magnetic_field_covariance.any()


def test_the_originals_can_be_left_out(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", entries("mcap", readings()))
    applied(tmp_path, bag, replace=True)
    assert set(content(tmp_path / "out")) == {"/imu/mag/calibrated", "/pose", "/note", VERDICT}


def test_units_are_those_of_the_calibration_or_of_a_configuration(tmp_path: Path) -> None:
    z = readings()
    bag = write(tmp_path, "mcap", entries("mcap", z, per_tesla=0.01))
    gauss = calibration(sensor("imu/mag"), options={"bag": {"units": "gauss"}})
    applied(tmp_path, bag, gauss)
    expected = z - [3.0, -2.0, 7.0]
    np.testing.assert_allclose(calibrated(tmp_path / "out").field, expected, rtol=0, atol=1e-12)
    (tmp_path / "c.yaml").write_text("bag: {units: gauss}")
    applied(tmp_path, bag, config=tmp_path / "c.yaml", out=tmp_path / "again")
    with pytest.raises(L2MError, match=r"it is likely gauss: set `bag\.units"):
        applied(tmp_path, bag, out=tmp_path / "third")
    assert not (tmp_path / "third").exists()


def test_sensors_of_one_topic_get_topics_of_their_own(tmp_path: Path) -> None:
    make = ros("mcap")
    found = [
        Entry("/m", "sensor_msgs/MagneticField", START + k, make.magnetic(START + k, z, frame))
        for k, z in enumerate(readings(20) * 1e-6)
        for frame in ("left", "right", "third")
    ]
    bag = write(tmp_path, "mcap", found)
    split = {"options": {"bag": {"split_by_frame": True}}}
    result = calibration(sensor("left"), sensor("right", TURN), sensor("gone"), **split)
    done = applied(tmp_path, bag, result)
    assert done.topics == {"left": "/m/left/calibrated", "right": "/m/right/calibrated"}
    assert done.notes == ("gone is not in the bag", "third is not in the calibration")
    left, right = (calibrated(tmp_path / "out", each).field for each in done.topics.values())
    np.testing.assert_allclose(left @ TURN, right, rtol=0, atol=1e-12)
    with pytest.raises(BagError, match="carries readings in several frames"):
        applied(tmp_path, bag, calibration(sensor("left")), out=tmp_path / "x")


def test_blocks_do_not_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write(tmp_path, "ros1", entries("ros1", readings(50)))
    applied(tmp_path, bag)
    monkeypatch.setattr(calibrated_topics, "BLOCK_MESSAGES", 7)
    applied(tmp_path, bag, out=tmp_path / "small.bag")
    monkeypatch.setattr(calibrated_topics, "BLOCK_BYTES", 1)
    applied(tmp_path, bag, out=tmp_path / "smaller.bag")
    whole = content(tmp_path / "out.bag")
    for name in ("small.bag", "smaller.bag"):
        parts = content(tmp_path / name)
        assert {t: [when for when, _ in m] for t, m in parts.items()} == {
            t: [when for when, _ in m] for t, m in whole.items()
        }
        # the order in which a batch is summed up moves the last digits
        found, expected = (calibrated(tmp_path / each).field for each in (name, "out.bag"))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


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


def test_sensors_that_cannot_be_corrected_are_named(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", entries("mcap", readings()))
    endless = MovingField("motor", np.ones(3), np.full(3, np.inf))
    dead = unsolved("c", SensorStatus.DEAD_AXIS, "x is dead")
    done = applied(
        tmp_path, bag, calibration(*made().sensors, sensor("b", moving=(endless,)), dead)
    )
    assert done.notes == (
        "b is left out: what follows motor is not determined",
        "c is left out: it is not calibrated (dead axis): x is dead",
        "b is not in the bag",
        "c is not in the bag",
    )
    with pytest.raises(CalibrationError, match="no sensor is left to be written: c: it is not"):
        applied(tmp_path, bag, calibration(dead), out=tmp_path / "x")
    with pytest.raises(BagError, match=r"can correct none of its sensors \(imu/mag\)"):
        applied(tmp_path, bag, calibration(sensor("other")), out=tmp_path / "x")


@pytest.mark.parametrize("stamps", ["header", "record"])
def test_what_follows_a_motor_is_taken_out(stamps: str, tmp_path: Path) -> None:
    """Its current is known up to the twentieth reading; the clock of the record is 5 ms later."""
    h, sigma = np.array([0.5, -0.2, 0.1]), np.array([0.01, 0.02, 0.03])
    make, found, b = ros("mcap"), [], readings()
    current = 3 + np.sin(np.arange(30))
    for k, amperes in enumerate(current):
        stamp = START + k * STEP
        reading = make.magnetic(stamp, (b[k] + [3.0, -2.0, 7.0] + amperes * h) * 1e-6)
        found.append(Entry("/mag", "sensor_msgs/MagneticField", stamp + 5_000_000, reading))
        if k < 20:
            told = make.pose_stamped(stamp, [1000 * amperes, 0, 0], [0, 0, 0, 1])
            found.append(Entry("/motor", "geometry_msgs/PoseStamped", stamp + 5_000_000, told))
    bag = write(tmp_path, "mcap", found)
    motor = {"topic": "/motor", "field": "pose.position.x", "scale": 0.001}
    options = {"bag": {"regressors": {"motor": motor}, "stamps": stamps}}
    exact: dict[str, Any] = {"covariance": np.zeros((15, 15)), "time_offset": None, "noise": 0.1}
    moving = sensor("mag", moving=(MovingField("motor", h, sigma),), **exact)
    applied(tmp_path, bag, calibration(moving, options=options))
    field_ut = calibrated(tmp_path / "out", "/mag/calibrated").field
    np.testing.assert_allclose(field_ut[:20], b[:20], rtol=0, atol=1e-12)
    assert np.isnan(field_ut[20:]).all()
    raw = content(tmp_path / "out")["/mag/calibrated"][7][1]
    message: Any = ros("mcap").store.deserialize_cdr(raw, "sensor_msgs/msg/MagneticField")
    expected = 1e-12 * np.diag(0.1**2 + (current[7] * sigma) ** 2)
    np.testing.assert_allclose(
        message.magnetic_field_covariance, expected.ravel(), rtol=1e-12, atol=1e-27
    )
    with pytest.raises(ConfigError, match="follows 'motor', which `bag"):
        applied(tmp_path, bag, calibration(moving), out=tmp_path / "x")


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


def test_a_frame_that_is_no_name(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", entries("mcap", readings()))
    with pytest.raises(ConfigError, match="'my lidar' is no name of a frame"):
        applied(tmp_path, bag, lidar_frame="my lidar")


def test_options_that_were_tampered_with(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", entries("mcap", readings()))
    options: dict[str, Any]
    for options, key in (
        ({"bag": {"units": "furlong"}}, "options.bag.units: "),
        ({"bag": 7}, "options.bag: "),
        ({"calibration": {"regressors": {"max_gap_s": -1}}}, "options.calibration.regressors.max"),
        ({"calibration": 7}, "options.calibration.regressors: "),
    ):
        odd = calibration(sensor("imu/mag"), options=options)
        with pytest.raises(CalibrationError, match=f"calibration.yaml: {key}"):
            applied(tmp_path, bag, odd)
