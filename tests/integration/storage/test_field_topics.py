"""Readings and poses in other messages than MagneticField and Odometry."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rosbags.typesys import get_types_from_msg

from l2m_gtsam.errors import BagError, UnitsError
from l2m_gtsam.storage.bag import has_fields, read_fields, read_recording, read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.inspect import inspect_bag
from l2m_gtsam.storage.units import Unit
from tests.drives.bags import Entry, ros, write

START = 1_700_000_000_000_000_000
STEP = 100_000_000
COUNT = 30
EARTH_UT = np.array([20.0, 5.0, -40.0])


def field_ut(k: int) -> Any:
    return EARTH_UT + np.sin([k, 2 * k, 3 * k])


def vectors(topic: str, scale: float) -> list[Entry]:
    make, found = ros("mcap"), []
    for k in range(COUNT):
        stamp = START + k * STEP
        message = make(
            "geometry_msgs/Vector3Stamped",
            header=make.header(stamp, "imu"),
            vector=make.vector(scale * field_ut(k)),
        )
        found.append(Entry(topic, "geometry_msgs/Vector3Stamped", stamp, message))
    return found


def path_messages(topic: str, *, window: int | None = None, planned: bool = False) -> list[Entry]:
    """Paths that grow, or slide along with so many poses, or are plans."""
    make, found = ros("mcap"), []
    for k in range(COUNT):
        first = 0 if window is None else max(0, k + 1 - window)
        poses = [
            make.pose_stamped(
                START + (0 if planned else n * STEP), [0.2 * n + 0.001 * k, 1, 0], [0, 0, 0, 1]
            )
            for n in range(first, k + 1)
        ]
        stamp = START + k * STEP
        message = make("nav_msgs/Path", header=make.header(stamp, "map"), poses=poses)
        found.append(Entry(topic, "nav_msgs/Path", stamp, message))
    return found


def in_order(*entries: list[Entry]) -> list[Entry]:
    return sorted((each for some in entries for each in some), key=lambda each: each.record_ns)


def test_stamped_vectors_and_a_growing_path(tmp_path: Path) -> None:
    """As a driver before MagneticField and LIO-SAM publish them."""
    content = in_order(vectors("/imu/mag", 1e-2), path_messages("/lio_sam/mapping/path"))
    bag = write(tmp_path, "mcap", content)
    with pytest.raises(UnitsError, match=r"unit that the log does not state.*`bag.units: gauss`"):
        read_recording(bag, BagOptions())
    found = read_recording(bag, BagOptions(units=Unit.GAUSS))
    expected = np.array([field_ut(k) for k in range(COUNT)])
    np.testing.assert_allclose(found.series[0].field, expected, rtol=1e-12)
    # All as the last path has them.
    shift = 0.001 * (COUNT - 1)
    np.testing.assert_allclose(found.trajectory.p[:, 0], 0.2 * np.arange(COUNT) + shift)
    assert found.trajectory.frame == "map"
    report = inspect_bag(bag, BagOptions(units=Unit.GAUSS))
    assert report.obstacles == ()
    assert [each.use for each in report.topics] == [
        "magnetic readings",
        "poses (the only topic with poses)",
    ]


def test_a_path_that_slides_along(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", path_messages("/path", window=5))
    found = read_trajectory(bag, BagOptions())
    # Each pose as the last path that had it.
    last = np.minimum(np.arange(COUNT) + 4, COUNT - 1)
    np.testing.assert_allclose(found.p[:, 0], 0.2 * np.arange(COUNT) + 0.001 * last)


def test_a_plan_is_no_drive(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", path_messages("/plan", planned=True))
    with pytest.raises(BagError, match=r"/plan have one stamp.*shall go.*`bag.poses`"):
        read_trajectory(bag, BagOptions())


def test_vectors_that_nobody_called_magnetic(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", in_order(vectors("/wrench", 1.0), path_messages("/path")))
    with pytest.raises(BagError, match=r"if /wrench has one, say so with `bag.fields`"):
        read_recording(bag, BagOptions())
    report = inspect_bag(bag, BagOptions())
    assert report.topics[1].use == "vectors: of a magnetometer if `bag.fields` names them"
    assert len(report.obstacles) == 1
    named = read_fields(bag, BagOptions(fields=("/wrench",), units=Unit.MICROTESLA))
    assert [each.sensor for each in named] == ["wrench"]


@pytest.mark.parametrize("named", ["/compass", "compass:vector"])
def test_a_bag_has_the_readings_that_options_name(tmp_path: Path, named: str) -> None:
    bag = write(tmp_path, "mcap", vectors("/compass", 1.0))
    assert not has_fields(bag, BagOptions())
    assert not has_fields(bag, BagOptions(fields=("/elsewhere",)))
    assert has_fields(bag, BagOptions(fields=(named,)))


def test_inspect_looks_at_every_path_of_a_topic(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", in_order(vectors("/mag", 1.0), path_messages("/path")))
    options = BagOptions(fields=("/mag:nothing", "/mag:vector"), units=Unit.MICROTESLA)
    with pytest.raises(BagError, match=r"on /mag has no 'nothing'"):
        read_recording(bag, options)
    (line,) = inspect_bag(bag, options).obstacles
    assert line.startswith("/mag: refused: it has no 'nothing'")


DRIVER = """std_msgs/Header header
uint16 group_fields
geometry_msgs/Vector3 imu_accel
geometry_msgs/Vector3 magpres_mag
float32[3] raw
"""


def test_fields_inside_messages_of_drivers(tmp_path: Path) -> None:
    """A known type by itself, any member of any type by its path."""
    make = ros("mcap")
    make.store.register(get_types_from_msg(DRIVER, "vectornav_msgs/msg/CommonGroup"))
    content = []
    for k in range(COUNT):
        message = make(
            "vectornav_msgs/CommonGroup",
            header=make.header(START + k * STEP, "vn"),
            group_fields=0,
            imu_accel=make.vector([0, 0, 9.8]),
            magpres_mag=make.vector(0.01 * field_ut(k)),
            raw=np.round(10 * field_ut(k)).astype(np.float32),
        )
        content.append(Entry("/vn", "vectornav_msgs/CommonGroup", START + k * STEP, message))
    bag = written_with(make, tmp_path / "bag", content)
    (known,) = read_fields(bag, BagOptions())
    expected = np.array([field_ut(k) for k in range(COUNT)])
    np.testing.assert_allclose(known.field, expected, rtol=1e-12)
    (raw,) = read_fields(bag, BagOptions(fields=("/vn:raw",), units=0.1))
    np.testing.assert_allclose(raw.field, expected, atol=0.05 + 1e-9)  # rounded to 0.1 uT
    with pytest.raises(UnitsError, match=r"raw counts.*`bag.units: 0.15`"):
        read_fields(bag, BagOptions(fields=("/vn:raw",)))
    with pytest.raises(BagError, match=r"/vn has no 'mag': it has the fields header, group_fields"):
        read_fields(bag, BagOptions(fields=("/vn:mag",)))
    with pytest.raises(BagError, match=r"no x, y and z in 'group_fields': it is a single number"):
        read_fields(bag, BagOptions(fields=("/vn:group_fields",)))


def written_with(make: Any, path: Path, content: list[Entry]) -> Path:
    """Write a bag with types that ROS does not bring."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        msgtype = content[0].msgtype.replace("/", "/msg/")
        connection = writer.add_connection(content[0].topic, msgtype, typestore=make.store)
        for each in content:
            data = make.store.serialize_cdr(each.message, msgtype)
            writer.write(connection, each.record_ns, data)
    return path


def test_axes_that_a_driver_mixes_are_put_in_order(tmp_path: Path) -> None:
    bag = write(tmp_path, "mcap", vectors("/imu/mag", 1.0))
    options = BagOptions(units=Unit.MICROTESLA, axes={"imu/*": ("y", "-x", "z")})
    (found,) = read_fields(bag, options)
    expected = np.array([field_ut(k) for k in range(COUNT)])[:, [1, 0, 2]] * [1, -1, 1]
    np.testing.assert_allclose(found.field, expected, rtol=1e-12)
    with pytest.raises(ValidationError, match="each of x, y and z must be there once"):
        BagOptions(axes={"mag": ("x", "x", "z")})


def test_a_single_name_is_a_list_of_one(tmp_path: Path) -> None:
    """And a number, or a unit, comes back from a file as it was."""
    options = BagOptions.model_validate({"fields": "/mag_00", "units": 0.0578})
    assert options.fields == ("/mag_00",)
    assert BagOptions.model_validate(options.model_dump(mode="json")) == options
    for wrong in ("furlong", -1, 0, True, float("nan"), None):
        with pytest.raises(ValidationError, match=r"accepted: auto, tesla.*microtesla per count"):
            BagOptions.model_validate({"units": wrong})


def test_inspect_names_a_constant_and_an_impossible_field(tmp_path: Path) -> None:
    make = ros("mcap")
    stuck = [
        Entry("/mag", "sensor_msgs/MagneticField", s, make.magnetic(s, [1.5, 0, 0]))
        for s in range(START, START + COUNT * STEP, STEP)
    ]
    bag = write(tmp_path, "mcap", in_order(stuck, path_messages("/path")))
    report = inspect_bag(bag, BagOptions())
    assert report.topics[0].use == (
        "magnetic readings, but all are (1.5, 0, 0) as written: the sensor is stuck, and 1.5e+06 "
        "uT is no field on Earth"
    )
    assert report.obstacles == ("no magnetic topic has readings that change",)
