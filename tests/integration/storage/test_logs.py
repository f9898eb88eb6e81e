"""Logs that are no bags: tables of several programs, and ULogs of PX4."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyulog import ULog
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import BagError, Notice, UnitsError
from l2m_gtsam.storage.bag import read_fields, read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions, ColumnOptions, PoseFileOptions, RegressorTopic
from l2m_gtsam.storage.inspect import inspect_bag
from l2m_gtsam.storage.regressors import read_scalars
from l2m_gtsam.storage.units import Unit
from tests.support.ulog import write_ulog

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000
COUNT = 60
UPTIME_NS = 341_986_128_864_000  # four days: in milliseconds a date no sooner than 12,800
EARTH = np.array([20.0, 5.0, -40.0])


def readings(scale: float = 1.0) -> FloatArray:
    """Readings of a sensor that turns, shape (N, 3), in microtesla times a scale."""
    k = np.arange(COUNT)[:, None]
    return np.asarray(scale * (EARTH + 3 * np.sin(0.1 * k * [1, 2, 3])))


def poses() -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3) and quaternions (N, 4) of a drive along x that turns."""
    k = np.arange(COUNT)
    p = np.column_stack([0.1 * k, np.ones(COUNT), 0.5 + 0.01 * k])
    return p, Rotation.from_rotvec(np.outer(k, [0.01, 0.02, 0.05])).as_quat()


def table(path: Path, names: list[str], rows: list[list[object]], delimiter: str = ",") -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow(names)
        writer.writerows(rows)
    return path


def stamps_ns() -> list[int]:
    return (START_NS + STEP_NS * np.arange(COUNT)).tolist()


def test_a_table_of_one_s_own(tmp_path: Path) -> None:
    p, q = poses()
    names = [
        "stamp",
        "mag_0_x_ut",
        "mag_0_y_ut",
        "mag_0_z_ut",
        "x",
        "y",
        "z",
        "qx",
        "qy",
        "qz",
        "qw",
    ]
    rows = [
        [f"{s // 10**9}.{s % 10**9:09d}", *b, *place, *turn]
        for s, b, place, turn in zip(stamps_ns(), readings(), p, q, strict=True)
    ]
    found = read_recording(table(tmp_path / "drive.csv", names, rows), BagOptions())
    assert [each.sensor for each in found.series] == ["mag_0"]
    np.testing.assert_array_equal(found.series[0].stamp_ns, stamps_ns())
    np.testing.assert_allclose(found.series[0].field, readings(), rtol=1e-12)
    np.testing.assert_allclose(found.trajectory.p, p, rtol=1e-12)
    np.testing.assert_allclose(found.trajectory.R, Rotation.from_quat(q).as_matrix(), atol=1e-12)


ROSTOPIC = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.magnetic_field.x,"
    "field.magnetic_field.y,field.magnetic_field.z,field.magnetic_field_covariance0"
)
TABLES: dict[str, tuple[str, Callable[[int, list[float]], list[object]]]] = {
    # rostopic echo -p, PlotJuggler, phyphox, Sensor Logger, ulog2csv: their names of columns.
    "rostopic.csv": (
        ROSTOPIC,
        lambda k, b: [START_NS, k, START_NS + k * STEP_NS, "mag", *b, 0],
    ),
    "plotjuggler.csv": (
        "__time,/imu/mag/magnetic_field/x,/imu/mag/magnetic_field/y,/imu/mag/magnetic_field/z",
        lambda k, b: [f"{1_700_000_000 + k // 50}.{(k % 50) * 2:02d}", *b],
    ),
    "phyphox.csv": (
        '"Time (s)","Magnetic field x (µT)","Magnetic field y (µT)","Magnetic field z (µT)"',
        lambda k, b: [f"{0.02 * k:.2f}", *b],
    ),
    "Magnetometer.csv": (
        "time,seconds_elapsed,z,y,x",
        lambda k, b: [START_NS + k * STEP_NS, 0.02 * k, b[2], b[1], b[0]],
    ),
    # What else such programs write: an axis and its unit alone, dates, times since the last start.
    "Raw Data.csv": (
        '"Time (s)","X (µT)","Y (µT)","Z (µT)"',
        lambda k, b: [f"{0.02 * k:.2f}", *b],
    ),
    "SensorLog.csv": (
        "Timestamp,timeIntervalSince1970,GyroX,GyroY,GyroZ,MagX,MagY,MagZ",
        lambda k, b: [f"today {k}", f"{1_700_000_000 + 0.02 * k:.2f}", 1, 2, 3, *b],
    ),
    "dates.csv": (
        "Time,Timestamp,mag_x,mag_y,mag_z",
        lambda k, b: [k, f"2023-11-14 22:13:{20 + 0.02 * k:06.3f}", *b],
    ),
    "zones.csv": (
        "timestamps,mag_x,mag_y,mag_z",
        lambda k, b: [f"2023-11-15T00:13:{20 + 0.02 * k:06.3f}+02:00", *b],
    ),
    "uptime.csv": (
        ",time,gyro_x,gyro_y,gyro_z,magnet_x,magnet_y,magnet_z",
        lambda k, b: [k, f"{UPTIME_NS + k * STEP_NS}.0", 1, 2, 3, *b],
    ),
    "groups.csv": (
        "Time (s),IMU Gyroscope,,,IMU Magnetometer,,\n,X,Y,Z,X,Y,Z",
        lambda k, b: [f"{0.02 * k:.2f}", 1, 2, 3, *b],
    ),
    "vehicle_magnetometer_0.csv": (
        "timestamp,magnetometer_ga[0],magnetometer_ga[1],magnetometer_ga[2]",
        lambda k, b: [20_000 * k, *b],
    ),
}
BEGIN = {
    **dict.fromkeys(("phyphox.csv", "Raw Data.csv", "groups.csv", "vehicle_magnetometer_0.csv"), 0),
    "uptime.csv": UPTIME_NS,
}
STATED = ("phyphox.csv", "Raw Data.csv", "vehicle_magnetometer_0.csv")


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_other_programs(tmp_path: Path, name: str) -> None:
    head, row = TABLES[name]
    path = tmp_path / name
    lines = [head, *(",".join(map(str, row(k, b))) for k, b in enumerate(readings().tolist()))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if name not in STATED:
        with pytest.raises(UnitsError, match=r"in a unit that the log does not state.*microtesla"):
            read_fields(path, BagOptions())
    if name == "vehicle_magnetometer_0.csv":  # 45 gauss is no field on Earth
        with pytest.raises(UnitsError, match="as read in gauss"):
            read_fields(path, BagOptions())
    (found,) = read_fields(path, BagOptions(units=Unit.MICROTESLA))
    np.testing.assert_allclose(found.field, readings(), rtol=1e-12)
    begin = BEGIN.get(name, START_NS)
    np.testing.assert_array_equal(found.stamp_ns, begin + STEP_NS * np.arange(COUNT))


def test_a_table_without_its_name(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text("stamp,mag_x,mag_y,mag_z\n1,2,3,4\n")
    with pytest.raises(BagError, match=r"call a table \.csv"):
        read_fields(path, BagOptions())


def test_named_columns_and_raw_counts(tmp_path: Path) -> None:
    counts = np.round(readings(1 / 0.0578)).astype(int)
    names = ["when", "raw a", "raw b", "raw c", "north"]
    rows: list[list[object]] = [[20 * k, *each, 1] for k, each in enumerate(counts.tolist())]
    path = table(tmp_path / "counts.csv", names, rows, delimiter=";")
    with pytest.raises(BagError, match=r"no column with times.*columns.stamp.*raw a"):
        read_fields(path, BagOptions())
    columns = ColumnOptions(stamp="when", fields={"left": ("raw a", "raw b", "raw c")})
    with pytest.raises(
        UnitsError, match=r"whole number.*raw counts.*microtesla per count"
    ) as error:
        read_fields(path, BagOptions(columns=columns))
    assert "milligauss" not in str(error.value)
    (found,) = read_fields(path, BagOptions(columns=columns, units=0.0578))
    np.testing.assert_allclose(found.field, 0.0578 * counts, rtol=1e-12)
    # 20 as a step of times since a start is milliseconds: nobody reads every 20 s.
    np.testing.assert_array_equal(found.stamp_ns, STEP_NS * np.arange(COUNT))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "is empty"),
        ("1,2,3,4\n1,2,3,4\n", "first line is numbers"),
        ("stamp,mag_x,mag_y,mag_z\n", "no rows below"),
        ("stamp,mag_x,mag_y,mag_z\n1,2,3\n", "line 2 has 3 columns, 4 are needed"),
        ("stamp,mag_x,mag_y,mag_z\n1,2,3,north\n", "line 2: 'north' is no number"),
        ("stamp,mag_x,mag_y,mag_z\nnow,2,3,4\n", "line 2: 'now' is no time"),
        ("stamp,mag_x,mag_y,mag_z\n2024-01-01,2,3,4\nx,2,3,4\n", "line 3: 'x' is no date"),
        ("stamp,speed\n1,2\n", "no columns of a magnetometer"),
        ("stamp,mag_x,mag_y,mag_z\n" + "1,2,3,4\n" * 30, "in a unit that the log|no poses"),
    ],
)
def test_what_is_no_log_is_one_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises((BagError, UnitsError), match=told) as error:
        read_recording(path, BagOptions())
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        ("mag_y,mag_x,x,y,z,qx,qy,qz,qw", "columns mag_y, mag_x without the one of z"),
        ("bx,by,bz,x,y,z,qx,qy,qz", "columns qx, qy, qz without the one of w"),
        ("bx,by,bz,pos_x,pos_z,q_w,q_x,q_y,q_z", "columns pos_x, pos_z without the one of y"),
    ],
)
def test_columns_of_which_one_is_missing_are_named(tmp_path: Path, head: str, said: str) -> None:
    path = tmp_path / "log.csv"
    count = head.count(",") + 1
    lines = (f"{k}," + ",".join(str(k + column) for column in range(count)) for k in range(3))
    path.write_text("\n".join(["stamp," + head, *lines]))
    with pytest.warns(Notice, match=f"log.csv: left out: {said}"):
        inspect_bag(path, BagOptions())


def ned(p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses of ROS' axes in those of PX4: north, east, down, and quaternions with w first."""
    E, F = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    R = E.T @ Rotation.from_quat(q).as_matrix() @ F.T
    return p @ E, Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]


def flight(path: Path, *, odometry: bool) -> Path:
    """Write a ULog with two magnetometers, a current, and poses of one kind or the other."""
    stamps = 1_000_000 + 20_000.0 * np.arange(COUNT)
    p, q = ned(*poses())
    mag = {"magnetometer_ga": 3}
    topics: list[Any] = [
        ("vehicle_magnetometer", 0, mag, stamps, readings(0.01)),
        ("vehicle_magnetometer", 1, mag, stamps + 5000, readings(0.009)),
        ("sensor_mag", 0, {"x": 1, "y": 1, "z": 1}, stamps, readings(0.01)),
        ("battery_status", 0, {"current_a": 1}, stamps, np.arange(COUNT)[:, None]),
    ]
    if odometry:
        both = np.column_stack([p, q])
        topics.append(("vehicle_odometry", 0, {"position": 3, "q": 4}, stamps, both))
    else:
        topics.append(("vehicle_local_position", 0, {"x": 1, "y": 1, "z": 1}, stamps, p))
        # Attitudes halfway between the positions, and one before and after.
        turns = Rotation.from_rotvec(np.outer(np.arange(-0.5, COUNT), [0.01, 0.02, 0.05]))
        _, between = ned(np.zeros((COUNT + 1, 3)), turns.as_quat())
        when = 990_000 + 20_000.0 * np.arange(COUNT + 1)
        topics.append(("vehicle_attitude", 0, {"q": 4}, when, between))
    return write_ulog(path, topics)


@pytest.mark.parametrize("odometry", [True, False])
def test_a_ulog(tmp_path: Path, odometry: bool) -> None:
    path = flight(tmp_path / "flight.ulg", odometry=odometry)
    written = ULog(str(path))  # PX4's own parser understands what was written
    assert sum(each.name == "vehicle_magnetometer" for each in written.data_list) == 2
    found = read_recording(path, BagOptions())
    assert [each.sensor for each in found.series] == [
        "vehicle_magnetometer_0",
        "vehicle_magnetometer_1",
    ]
    # Numbers of 32 bits.
    np.testing.assert_allclose(found.series[0].field, readings(), rtol=1e-6)
    expected = 1_005_000_000 + STEP_NS * np.arange(COUNT)
    np.testing.assert_array_equal(found.series[1].stamp_ns, expected)
    p, q = poses()
    np.testing.assert_allclose(found.trajectory.p, p, atol=1e-6)
    np.testing.assert_allclose(found.trajectory.R, Rotation.from_quat(q).as_matrix(), atol=1e-6)


def test_topics_of_a_ulog(tmp_path: Path) -> None:
    path = flight(tmp_path / "flight.ulg", odometry=True)
    raw = read_fields(path, BagOptions(fields="sensor_mag"))  # type: ignore[arg-type]
    assert [each.sensor for each in raw] == ["sensor_mag"]
    current = {"motors": RegressorTopic(topic="battery_status", field="current_a")}
    (motors,) = read_scalars(path, BagOptions(regressors=current))
    np.testing.assert_array_equal(motors.value, np.arange(COUNT))
    report = inspect_bag(path, BagOptions())
    assert report.obstacles == ()
    use = {each.topic: each.use for each in report.topics}
    assert use["/vehicle_magnetometer_1"] == "magnetic readings"
    assert use["/sensor_mag"].startswith("magnetic readings, not chosen")


def test_damaged_ulogs_are_one_line(tmp_path: Path) -> None:
    whole = flight(tmp_path / "flight.ulg", odometry=True).read_bytes()
    path = tmp_path / "part.ulg"
    for content in (b"", b"ULog", whole[:16], b"x" * 500):
        path.write_bytes(content)
        with pytest.raises(BagError) as error:
            read_recording(path, BagOptions())
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)


def test_a_ulog_of_strangers_is_no_danger(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Times that do not fit, names that are none, and what the parser prints of damage."""
    mag = {"magnetometer_ga": 3}
    late = np.asarray(9.1e15 + 20_000.0 * np.arange(COUNT), dtype=np.float64)
    path = write_ulog(tmp_path / "late.ulg", [("vehicle_magnetometer", 0, mag, late, readings())])
    with pytest.raises(BagError, match="damaged: times on /vehicle_magnetometer are those of no"):
        read_fields(path, BagOptions())
    stamps = np.asarray(20_000.0 * np.arange(1, COUNT + 1), dtype=np.float64)
    odd = ("class", 0, {"a b": 1, "class": 1, "1st": 1}, stamps, readings())
    good = ("vehicle_magnetometer", 0, mag, stamps, readings(0.01))
    path = write_ulog(tmp_path / "odd.ulg", [good, odd])
    data = bytearray(path.read_bytes())
    path.write_bytes(data + b"\x05\x00D\xff\x00abc")  # of a topic that is not there
    (found,) = read_fields(path, BagOptions())
    np.testing.assert_allclose(found.field, readings(), rtol=1e-6)
    assert capfd.readouterr().out == ""


def test_poses_of_a_file_beside_a_log(tmp_path: Path) -> None:
    p, q = poses()
    rows: list[list[object]] = [
        [s, *b] for s, b in zip(stamps_ns(), readings().tolist(), strict=True)
    ]
    log = table(tmp_path / "mag.csv", ["stamp_ns", "bx_ut", "by_ut", "bz_ut"], rows)
    lines = [
        " ".join(map(str, [f"{s // 10**9}.{s % 10**9:09d}", *place, *turn]))
        for s, place, turn in zip(stamps_ns(), p, q, strict=True)
    ]
    (tmp_path / "traj.tum").write_text("\n".join(lines))
    with pytest.raises(BagError, match="--poses"):
        read_recording(log, BagOptions())
    options = BagOptions(pose_file=PoseFileOptions(path=tmp_path / "traj.tum"))
    found = read_recording(log, options)
    np.testing.assert_allclose(found.trajectory.p, p, rtol=1e-12)
    np.testing.assert_allclose(read_trajectory(log, options).p, p, rtol=1e-12)
    assert "traj.tum (sha256 " in found.origins[0]
    assert found.poses is not None
    assert found.poses.sha256 in found.origins[0]
    assert inspect_bag(log, options).obstacles == ()
    late = PoseFileOptions(path=tmp_path / "traj.tum", offset_s=1e6)
    with pytest.raises(BagError, match=r"different clocks.*traj.tum with `bag.pose_file.offset_s`"):
        read_recording(log, BagOptions(pose_file=late))
    (line,) = inspect_bag(log, BagOptions(pose_file=late)).obstacles
    assert line.endswith(f"to the times of {late.path} with `bag.pose_file.offset_s`")
