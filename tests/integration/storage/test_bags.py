"""Reading small bags of every kind."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.errors import BagError, L2MError, UnitsError
from l2m_gtsam.storage.bag import read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions, FixedTransform, Stamps, TfChain
from l2m_gtsam.storage.inspect import inspect_bag
from l2m_gtsam.storage.open_bag import open_bag
from l2m_gtsam.storage.units import Unit
from tests.drives.bags import KINDS, Entry, ros, write
from tests.support.memory import with_peak

START = 1_700_000_000_000_000_000
STEP = 100_000_000
EARTH = np.array([20e-6, 5e-6, -40e-6])


def entries(
    kind: str,
    count: int = 30,
    *,
    field: Callable[[int], np.ndarray] = lambda k: EARTH + 1e-6 * np.sin([k, 2 * k, 3 * k]),
    topics: tuple[str, ...] = ("/mag",),
    field_start: int = START,
    pose_start: int = START,
    record_start: int = START,
) -> list[Entry]:
    """Return poses along x with a turn about z, and readings at the same stamps."""
    make = ros(kind)
    found = []
    for k in range(count):
        record = record_start + k * STEP + 5_000_000
        q = Rotation.from_euler("z", 0.1 * k).as_quat()
        stamp = pose_start + k * STEP * (pose_start > 0)
        pose = make.pose_stamped(stamp, [0.2 * k, 1.0, 0.5], q)
        found.append(Entry("/pose", "geometry_msgs/PoseStamped", record, pose))
        for index, topic in enumerate(topics):
            stamp = field_start + k * STEP * (field_start > 0)
            reading = make.magnetic(stamp, field(k), f"mag_{index}")
            found.append(Entry(topic, "sensor_msgs/MagneticField", record + 1 + index, reading))
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_written_is_read(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind, entries(kind, topics=("/a/mag", "/b/mag")))
    found = read_recording(path, BagOptions())
    assert [s.sensor for s in found.series] == ["a/mag", "b/mag"]
    assert found.series[1].frame == "mag_1"
    assert (found.trajectory.frame, found.trajectory.child_frame) == ("map", "lidar")
    k = np.arange(30)
    np.testing.assert_array_equal(found.trajectory.stamp_ns, START + k * STEP)
    np.testing.assert_allclose(found.trajectory.p[:, 0], 0.2 * k, atol=1e-12)
    expected = Rotation.from_rotvec(np.outer(0.1 * k, [0, 0, 1])).as_matrix()
    np.testing.assert_allclose(found.trajectory.R, expected, atol=1e-12)
    # tesla to microtesla costs one rounding
    np.testing.assert_allclose(
        found.series[0].field[3], 1e6 * EARTH + np.sin([3, 6, 9]), rtol=1e-14
    )
    assert len(found.source.sha256) == 64


@pytest.mark.parametrize("kind", KINDS)
def test_record_time_by_option(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind, entries(kind, field_start=0, pose_start=0))
    with pytest.raises(BagError, match=r"header stamps are 0.*`bag.stamps: record`"):
        read_recording(path, BagOptions())
    found = read_recording(path, BagOptions(stamps=Stamps.RECORD))
    assert found.trajectory.stamp_ns[0] == START + 5_000_000


def test_simulated_against_record_clock(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", entries("mcap", pose_start=900_000_000_000))
    with pytest.raises(BagError, match=r"1700000000.000.*900.000.*different clocks.*record"):
        read_recording(path, BagOptions())
    assert len(read_recording(path, BagOptions(stamps=Stamps.RECORD)).trajectory) == 30


def test_topics_by_glob_and_one_topic_by_frame(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1", entries("ros1", topics=("/front/mag", "/rear/mag", "/extra")))
    found = read_recording(path, BagOptions(fields=("*/mag",)))
    assert [s.sensor for s in found.series] == ["front/mag", "rear/mag"]
    make = ros("mcap")
    mixed = [e for e in entries("mcap") if e.topic == "/pose"]
    for k in range(60):
        reading = make.magnetic(START + k * STEP // 2, EARTH, f"m{k % 2}")
        mixed.append(Entry("/mags", "sensor_msgs/MagneticField", START + k * STEP // 2, reading))
    path = write(tmp_path, "mcap", mixed, "mixed")
    found = read_recording(path, BagOptions(split_by_frame=True))
    assert [(s.sensor, len(s)) for s in found.series] == [("m0", 30), ("m1", 30)]


def test_fixed_transform_places_the_lidar(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", entries("mcap"))
    half = float(np.sqrt(0.5))  # 90 degrees about z
    fixed = FixedTransform(translation=(1.0, 0.0, 0.3), quaternion_xyzw=(0.0, 0.0, half, half))
    plain, moved = (
        read_recording(path, BagOptions(tracked_to_lidar=t)).trajectory
        for t in (FixedTransform(), fixed)
    )
    ahead = plain.p + plain.R @ [1.0, 0.0, 0.3]
    np.testing.assert_allclose(moved.p, ahead, atol=1e-12)
    np.testing.assert_allclose(moved.R[:, :, 0], plain.R[:, :, 1], atol=1e-12)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_tf_chain_with_static_and_inverse_links(tmp_path: Path, kind: str) -> None:
    """map -> odom (slow) -> base (fast) -> lidar (static); interpolated at base's stamps."""
    make = ros(kind)
    found = [e for e in entries(kind) if e.topic != "/pose"]

    def transforms(topic: str, stamp: int, *items: object) -> Entry:
        message = make("tf2_msgs/TFMessage", transforms=list(items))
        return Entry(topic, "tf2_msgs/TFMessage", stamp, message)

    unit = [0, 0, 0, 1]
    up = make.transform(START, "base", "lidar", [0, 0, 1], unit)
    found.append(transforms("/tf_static", START, up))
    for k in range(4):
        stamp = START + k * STEP * 10
        slow = make.transform(stamp, "map", "odom", [k, 0, 0], unit)
        found.append(transforms("/tf", stamp, slow))
    for k in range(31):
        stamp = START + k * STEP
        fast = make.transform(stamp, "odom", "base", [0, 0.5 * k, 0], unit)
        found.append(transforms("/tf", stamp, fast))
    path = write(tmp_path, kind, sorted(found, key=lambda e: e.record_ns))
    chain = TfChain(frame="map", child_frame="lidar")
    trajectory = read_recording(path, BagOptions(tf=chain)).trajectory
    tenths = np.arange(31)
    np.testing.assert_array_equal(trajectory.stamp_ns, START + tenths * STEP)
    expected = np.column_stack([0.1 * tenths, 0.5 * tenths, np.ones(31)])
    np.testing.assert_allclose(trajectory.p, expected, atol=1e-9)
    back = read_trajectory(path, BagOptions(tf=TfChain(frame="lidar", child_frame="map")))
    np.testing.assert_allclose(back.p, -expected, atol=1e-9)
    with pytest.raises(BagError, match=r"no tf chain from 'map' to 'drone'.*base, lidar, map"):
        read_trajectory(path, BagOptions(tf=TfChain(frame="map", child_frame="drone")))


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1e4, "gauss"), (1e6, "microtesla"), (1e9, "nanotesla"), (1e7, "milligauss")],
)
def test_units_are_suspected_and_overridden(tmp_path: Path, factor: float, unit: str) -> None:
    """The Earth's 45 uT written in another unit. 1e7: 450 mG is as likely 450 uT / 10."""
    path = write(tmp_path, "mcap", entries("mcap", field=lambda k: factor * EARTH * (1 + k / 100)))
    with pytest.raises(UnitsError, match=rf"/mag.*`bag.units: {unit}`") as error:
        read_recording(path, BagOptions())
    assert "\n" not in str(error.value)
    found = read_recording(path, BagOptions(units=Unit(unit)))
    np.testing.assert_allclose(found.series[0].field[0], 1e6 * EARTH, rtol=1e-9)


def test_directions_have_no_unit(tmp_path: Path) -> None:
    def direction(k: int) -> np.ndarray:
        v = EARTH + 1e-5 * np.sin([k, 2 * k, 3 * k])
        return np.asarray(v / np.linalg.norm(v))

    path = write(tmp_path, "mcap", entries("mcap", field=direction))
    for units in (Unit.AUTO, Unit.GAUSS):
        with pytest.raises(UnitsError, match="no unit at all"):
            read_recording(path, BagOptions(units=units))


def test_strengths_of_no_known_unit(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", entries("mcap", field=lambda k: EARTH * 1e-9 * (1 + k)))
    with pytest.raises(UnitsError, match="fits no unit of field"):
        read_recording(path, BagOptions())


def faulty(kind: str, name: str) -> tuple[list[Entry], BagOptions]:
    """Return a bag's content and options that must be refused."""
    good, make = entries(kind), ros(kind)
    only_poses = [e for e in good if e.topic == "/pose"]
    zero = make.pose_stamped(START, [0, 0, 0], [0, 0, 0, 0])
    return {
        "missing topic": (good, BagOptions(fields=("/compass",))),
        "wrong type": (good, BagOptions(fields=("/pose",))),
        "no magnetometer": (only_poses, BagOptions()),
        "missing poses": (good, BagOptions(poses="/odometry")),
        "poses of wrong type": (good, BagOptions(poses="/mag")),
        "no poses": ([e for e in good if e.topic == "/mag"], BagOptions()),
        "several poses": (
            [*good, *(Entry("/other", e.msgtype, e.record_ns, e.message) for e in only_poses)],
            BagOptions(),
        ),
        "poses by a glob": (
            [*good, *(Entry("/poses", e.msgtype, e.record_ns, e.message) for e in only_poses)],
            BagOptions(poses="/pose*"),
        ),
        "no tf": (good, BagOptions(tf=TfChain(frame="map", child_frame="lidar"))),
        "all NaN": (entries(kind, field=lambda k: np.full(3, np.nan)), BagOptions()),
        "zero quaternion": (
            [*good, Entry("/pose", "geometry_msgs/PoseStamped", START, zero)],
            BagOptions(),
        ),
    }[name]


FAULTS = {
    "missing topic": r"no topic of a magnetometer that matches '/compass'; there are: /mag ",
    "wrong type": r"/pose is of type geometry_msgs/msg/PoseStamped.* with readings there are: /mag",
    "no magnetometer": r"no topic of a magnetometer \(sensor_msgs/msg/MagneticField or .*: /pose ",
    "missing poses": r"no topic '/odometry' for the poses; with poses there are: /pose ",
    "poses of wrong type": r"/mag is of type .*, poses must be one of nav_msgs/msg/Odometry",
    "no poses": r"no poses in it; needed is .*`--poses`; there are: /mag ",
    "several poses": r"choose one with `bag.poses`: /other, /pose",
    "poses by a glob": r"choose one with `bag.poses`: /pose, /poses",
    "no tf": r"no /tf in the bag, but `bag.tf` asks",
    "all NaN": r"no finite reading in /mag",
    "zero quaternion": r"an orientation is all zero",
}


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_one_line(tmp_path: Path, kind: str, name: str) -> None:
    content, options = faulty(kind, name)
    path = write(tmp_path, kind, sorted(content, key=lambda e: e.record_ns))
    with pytest.raises(L2MError, match=FAULTS[name]) as error:
        read_recording(path, options)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def bag_file(path: Path) -> Path:
    """Return the file that holds the messages."""
    if path.is_file():
        return path
    return next(f for f in path.iterdir() if f.suffix in (".db3", ".mcap"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 0.97])
def test_truncated_bags_are_one_line(tmp_path: Path, kind: str, share: float) -> None:
    path = write(tmp_path, kind, entries(kind, 200))
    file = bag_file(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BagError, match=r"truncated|no messages") as error:
        read_recording(path, BagOptions())
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", KINDS)
def test_empty_bags(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind, [])
    with pytest.raises(BagError, match=r"no messages|truncated"):
        read_recording(path, BagOptions())


def test_paths_that_are_no_bags(tmp_path: Path) -> None:
    (tmp_path / "text.bag").write_text("hello")
    (tmp_path / "text.mcap").write_text("hello")
    for name in ("nowhere.bag", "text.bag", "text.mcap", "."):
        with pytest.raises(BagError, match=r"accepted: a ROS1 .bag"):
            read_recording(tmp_path / name, BagOptions())


@pytest.mark.parametrize("name", ["readings.csv", "flight.ulg"])
def test_a_table_where_a_bag_is_needed(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with (
        pytest.raises(BagError, match="a bag is needed here, this is a table"),
        open_bag(tmp_path / name),
    ):
        pass


@pytest.mark.parametrize(
    ("kind", "ending"), [("ros1", "BAG"), ("sqlite3", "DB3"), ("mcap", "Mcap")]
)
def test_endings_in_capitals(tmp_path: Path, kind: str, ending: str) -> None:
    file = bag_file(write(tmp_path, kind, entries(kind)))
    path = file.rename(tmp_path / f"DRIVE.{ending}")
    assert len(read_recording(path, BagOptions()).trajectory) == 30


def test_memory_does_not_grow_with_images(tmp_path: Path) -> None:
    """60 MB of images in the bag: the reader must stay under a third of that."""
    make = ros("mcap")
    found = entries("mcap")
    pixels = np.random.default_rng(0).integers(0, 255, 2_000_000, dtype=np.uint8)
    for k in range(30):
        image = make(
            "sensor_msgs/Image",
            header=make.header(START + k * STEP, "camera"),
            height=1000,
            width=2000,
            encoding="mono8",
            is_bigendian=0,
            step=2000,
            data=pixels,
        )
        found.append(Entry("/image", "sensor_msgs/Image", START + k * STEP, image))
    for kind in ("mcap", "sqlite3"):
        path = write(tmp_path, kind, sorted(found, key=lambda e: e.record_ns), kind)
        for work in (read_recording, inspect_bag):
            _, peak = with_peak(partial(work, path, BagOptions()))
            assert peak < 20e6


def test_inspect_tells_what_would_be_used(tmp_path: Path) -> None:
    def with_gaps(k: int) -> np.ndarray:
        return np.full(3, np.nan) if k % 3 == 0 else EARTH * (1 + k / 100)

    path = write(tmp_path, "mcap", entries("mcap", field=with_gaps))
    report = inspect_bag(path, BagOptions())
    mag, pose = report.topics
    assert (mag.topic, mag.msgtype, mag.count) == ("/mag", "sensor_msgs/msg/MagneticField", 30)
    assert mag.frames == ("mag_0",)
    assert mag.nan_share == pytest.approx(1 / 3)
    assert mag.rate_hz == pytest.approx(10)
    assert mag.longest_gap_s == pytest.approx(0.1)
    assert mag.clock_offset_s == pytest.approx(0.005, abs=1e-6)
    assert mag.strength is not None
    assert mag.strength.low == pytest.approx(1e6 * np.linalg.norm(EARTH) * 1.01)
    assert mag.use == "magnetic readings"
    assert pose.use == "poses (the only topic with poses)"
    assert report.obstacles == ()


def test_a_path_beside_poses_is_no_note(tmp_path: Path) -> None:
    """Most paths repeat the poses; `inspect` lists them all the same."""
    make, content = ros("mcap"), entries("mcap")
    poses = [make.pose_stamped(START + k * STEP, [0, 0, 0], [0, 0, 0, 1]) for k in range(3)]
    path = make("nav_msgs/Path", header=make.header(START, "map"), poses=poses)
    bag = write(tmp_path, "mcap", [*content, Entry("/path", "nav_msgs/Path", START, path)])
    assert not any("are those of" in each for each in read_recording(bag, BagOptions()).notes)
    (pose,) = (t for t in inspect_bag(bag, BagOptions()).topics if t.topic == "/pose")
    assert pose.use == "poses (preferred to /path; `bag.poses` chooses)"


def test_a_name_is_no_refusal(tmp_path: Path) -> None:
    make, content = ros("mcap"), entries("mcap")
    path = make("nav_msgs/Path", header=make.header(START, "map"), poses=[])
    bag = write(tmp_path, "mcap", [*content, Entry("/pose_refused", "nav_msgs/Path", START, path)])
    assert inspect_bag(bag, BagOptions()).obstacles == ()


def test_inspect_reports_instead_of_refusing(tmp_path: Path) -> None:
    content = [
        e for e in entries("mcap", field=lambda k: 1e4 * EARTH * (1 + k / 100)) if e.topic == "/mag"
    ]
    report = inspect_bag(write(tmp_path, "mcap", content), BagOptions())
    assert any("no poses in it" in line for line in report.obstacles)
    assert any("units: gauss" in line for line in report.obstacles)


def test_inspect_sees_clocks_that_cannot_work(tmp_path: Path) -> None:
    zero = write(tmp_path, "mcap", entries("mcap", field_start=0), "zero")
    (line,) = inspect_bag(zero, BagOptions()).obstacles
    assert line.startswith("/mag: all header stamps are 0")
    other = write(tmp_path, "mcap", entries("mcap", pose_start=900_000_000_000), "other")
    (line,) = inspect_bag(other, BagOptions()).obstacles
    assert "/mag starts at 1700000000.000 s, after /pose ends at 902.900 s" in line
    assert inspect_bag(other, BagOptions(stamps=Stamps.RECORD)).obstacles == ()


def test_a_stuck_sensor_does_not_stop_the_bag(tmp_path: Path) -> None:
    """One constant value, of any size, is no unit; the calibration reports the sensor."""
    content = entries("mcap", topics=("/good", "/stuck"))
    make = ros("mcap")
    for k, entry in enumerate(content):
        if entry.topic == "/stuck":
            reading = make.magnetic(entry.record_ns, [3e-6, 0, 0], "stuck")
            content[k] = Entry("/stuck", entry.msgtype, entry.record_ns, reading)
    found = read_recording(write(tmp_path, "mcap", content), BagOptions())
    assert [s.sensor for s in found.series] == ["good", "stuck"]
