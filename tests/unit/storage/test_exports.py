"""Which sensors go into the files of other programs, and what these files then say."""

import json
import math
import runpy
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.records.calibration import SensorStatus, TimeOffset
from l2m_gtsam.records.sensor_models import MovingField
from l2m_gtsam.storage.exports.bias_scale import (
    bias_scale_notes,
    bias_scale_text,
    not_reducible,
    reduced,
)
from l2m_gtsam.storage.exports.export import export_of, not_correctable, not_mounted
from l2m_gtsam.storage.exports.formats import json_text, kalibr_text, launch_text
from tests.drives.calibrations import (
    SIGMA,
    calibration,
    mounted,
    open_in,
    rotations,
    sensor,
    unsolved,
)

PLACES = st.tuples(*[st.floats(-3, 3) for _ in range(3)]).map(np.array)
# Of a point within 5 m, in double precision.
CLOSE = 1e-13


@dataclass(frozen=True)
class Node:
    """What a launch file says of a node; anything else of it is refused."""

    package: str
    executable: str
    arguments: list[str]


def launched(text: str) -> list[Node]:
    """Run a launch file with modules in the place of ROS' own, and return its nodes."""
    launch, launch_ros, actions = (ModuleType(n) for n in ("launch", "launch_ros", "actions"))
    launch.LaunchDescription = list  # type: ignore[attr-defined]
    actions.Node = Node  # type: ignore[attr-defined]
    modules = {"launch": launch, "launch_ros": launch_ros, "launch_ros.actions": actions}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in modules.items():
            patch.setitem(sys.modules, name, module)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "magnetometers.launch.py"
            path.write_text(text, encoding="utf-8")
            nodes: list[Node] = runpy.run_path(str(path))["generate_launch_description"]()
    return nodes


def named(arguments: list[str]) -> dict[str, str]:
    """Return arguments by name, as the publisher reads them: in pairs."""
    return dict(zip(arguments[::2], arguments[1::2], strict=True))


def point_in_lidar(R_mag_lidar: FloatArray, t: FloatArray) -> FloatArray:
    """Return where a point of the sensor's frame is in the lidar's: p = R^T q + t."""
    return np.array([0.4, -0.3, 1.1]) @ R_mag_lidar + t


@given(rotations(), PLACES)
def test_the_launch_file_publishes_the_sensors_place(R: FloatArray, t: FloatArray) -> None:
    text = launch_text(mounted([sensor("imu/mag", R, t_lidar_mag=t)], "velodyne"))
    (node,) = launched(text)
    assert (node.package, node.executable) == ("tf2_ros", "static_transform_publisher")
    given = named(node.arguments)
    assert (given["--frame-id"], given["--child-frame-id"]) == ("velodyne", "imu/mag")
    turn = Rotation.from_quat([float(given[f"--q{axis}"]) for axis in "xyzw"])
    place = np.array([float(given[f"--{axis}"]) for axis in "xyz"])
    found = turn.apply([0.4, -0.3, 1.1]) + place
    np.testing.assert_allclose(found, point_in_lidar(R, t), rtol=0, atol=CLOSE)
    assert set(given) == {"--frame-id", "--child-frame-id"} | {
        f"--{each}" for each in ("x", "y", "z", "qx", "qy", "qz", "qw")
    }


@given(rotations(), PLACES)
def test_kalibrs_matrix_goes_from_the_lidar_to_the_sensor(R: FloatArray, t: FloatArray) -> None:
    entry = YAML(typ="safe").load(kalibr_text(mounted([sensor("m", R, t_lidar_mag=t)])))["mag0"]
    T = np.array(entry["T_mag_lidar"])
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    found = T @ [*point_in_lidar(R, t), 1.0]
    np.testing.assert_allclose(found[:3], [0.4, -0.3, 1.1], rtol=0, atol=CLOSE)
    assert entry["timeshift_mag_lidar"] == 0.012
    assert entry["rostopic"] == "/m"


def test_kalibr_has_no_shift_that_was_held_and_no_topic_that_is_not_known() -> None:
    held = sensor("m", time_offset=TimeOffset(0.0, math.inf, np.zeros(15), "too slow"))
    whole = calibration(held, options={"bag": {"split_by_frame": True}})
    text = kalibr_text(export_of(whole, not_mounted, "lidar", {}))
    assert set(YAML(typ="safe").load(text)["mag0"]) == {"sensor", "frame", "T_mag_lidar"}


def test_kalibrs_topic_has_no_path_into_its_messages() -> None:
    (entry,) = YAML(typ="safe").load(kalibr_text(mounted([sensor("imu/data:mag")]))).values()
    assert entry["rostopic"] == "/imu/data"


@given(rotations())
def test_json_corrects_readings_and_moves_points(R: FloatArray) -> None:
    """An independent reader, which knows the file alone."""
    P = np.array([[1.1, 0.02, 0], [0.02, 0.9, 0.01], [0, 0.01, 1.0]])
    text = json_text(mounted([sensor("m", R, P)]))
    entry = json.loads(text)["sensors"]["m"]
    field_ut = np.array([20.0, -5.0, 40.0])
    reading = R @ P @ field_ut + [3.0, -2.0, 7.0]
    C, H = np.array(entry["C"]), np.array(entry["H"])
    # Condition of C times the strength times the precision is 1e-13.
    np.testing.assert_allclose(np.linalg.solve(C, reading - H), field_ut, rtol=0, atol=1e-12)
    there = entry["transforms"]["T_lidar_mag"]
    turn = Rotation.from_quat(there["quaternion_xyzw"])
    found = turn.apply([0.4, -0.3, 1.1]) + there["translation"]
    np.testing.assert_allclose(
        found, point_in_lidar(R, np.array([0.31, -0.12, 0.05])), rtol=0, atol=CLOSE
    )
    np.testing.assert_allclose(np.array(entry["C_sigma"]).shape, (3, 3))


def test_json_is_json_and_says_where_it_comes_from() -> None:
    only_place = open_in("m", slice(12, 15), "H: standstill")
    silent = unsolved("n", SensorStatus.NO_READINGS, "no readings")
    content = json.loads(json_text(mounted([only_place, silent])), parse_constant=pytest.fail)
    assert content["sensors"]["m"]["H_sigma"] == [None] * 3
    assert content["sensors"]["m"]["undetermined"] == ["H: standstill"]
    assert content["left_out"] == {"n": "it is not calibrated (no readings): no readings"}
    assert content["bag"]["sha256"] == "ab" * 32
    assert content["model"]["correction"] == "B_lidar = inv(C) @ (B_meas - H)"
    assert content["lidar_frame"] == "lidar"


@pytest.mark.parametrize(
    ("left", "mounting", "correction"),
    [
        (open_in("m", slice(2, 3), "t_z: planar"), "position is not determined: t_z: planar", None),
        (open_in("m", slice(12, 15), "H: still"), None, "offset H is not determined: H: still"),
        (
            open_in("m", slice(3, 12), "C: still", rotation_covariance=np.diag([np.inf, 0, 0])),
            "rotation is not determined: C: still",
            "distortion C is not determined",
        ),
        (
            sensor("m", status=SensorStatus.AMBIGUOUS, message="two places"),
            "it is not calibrated (ambiguous): two places",
            "it is not calibrated (ambiguous)",
        ),
        (
            unsolved("m", SensorStatus.DEAD_AXIS, "x is dead"),
            "it is not calibrated (dead axis): x is dead",
            "dead axis",
        ),
    ],
)
def test_what_is_not_known_is_left_out(
    left: Any, mounting: str | None, correction: str | None
) -> None:
    for fault, expected in ((not_mounted, mounting), (not_correctable, correction)):
        export = export_of(calibration(left, sensor("good")), fault, "lidar", {})
        names = [each.calibration.sensor for each in export.sensors]
        if expected is None:
            assert names == ["m", "good"]
            continue
        assert names == ["good"]
        assert expected in export.left_out["m"]
        assert any(expected in line for line in export.origin)
        with pytest.raises(CalibrationError, match="no sensor is left to be written: m: it"):
            export_of(calibration(left), fault, "lidar", {})


@pytest.mark.parametrize(
    ("lidar_frame", "frames", "message"),
    [
        ("lidar", {"c": "x"}, "--frame: no sensor 'c'; there are: a, b"),
        ("lidar", {"a": "b"}, "its frame 'b' is that of sensor 'a'"),
        ("b", {}, "its frame 'b' is that of the lidar"),
        ("my lidar", {}, "--lidar-frame: 'my lidar' is no name of a frame"),
        ("", {}, "is no name of a frame"),
        ("/lidar", {}, "is no name of a frame"),
        ("lidar", {"b": "x\n<evil/>"}, "is no name of a frame"),
    ],
)
def test_names_of_frames_are_checked(
    lidar_frame: str, frames: dict[str, str], message: str
) -> None:
    with pytest.raises(ConfigError) as error:
        export_of(calibration(sensor("a"), sensor("b")), not_mounted, lidar_frame, frames)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_name_cannot_leave_its_place() -> None:
    """Quotes and signs of the formats stay part of the name."""
    name = "a'b\"c<d>&#\\"
    (node,) = launched(launch_text(mounted([sensor(name)])))
    assert named(node.arguments)["--child-frame-id"] == name
    assert YAML(typ="safe").load(kalibr_text(mounted([sensor(name)])))["mag0"]["frame"] == name


@pytest.mark.parametrize("text", [json_text, kalibr_text, launch_text])
def test_half_characters_of_a_damaged_name_are_written(text: Any) -> None:
    """Half a surrogate pair, which YAML can spell and UTF-8 cannot hold."""
    whole = calibration(sensor("m\ud800"), unsolved("n", SensorStatus.DEAD_AXIS, "\ud800"))
    export = export_of(whole, not_mounted, "lidar", {"m\ud800": "m"})
    assert text(export).encode()


def test_comments_stay_comments() -> None:
    bad = unsolved("n", SensorStatus.NO_READINGS, "gone\nimport os\r--> \x1b[31m\u2028x: 1")
    export = mounted([sensor("m"), bad])
    assert len(launched(launch_text(export))) == 1
    assert set(YAML(typ="safe").load(kalibr_text(export))) == {"mag0"}
    assert all(line.isprintable() for line in export.origin)


@given(
    rotations(),
    st.tuples(*[st.floats(0.7, 1.4) for _ in range(3)]),
    st.tuples(*[st.floats(-0.012, 0.012) for _ in range(3)]),
)
def test_what_is_lost_bounds_what_a_consumer_sees(
    R: FloatArray, gains: tuple[float, float, float], mixed: tuple[float, float, float]
) -> None:
    """The parameter file alone, applied to fields of all directions in the sensor's axes."""
    M = np.diag(gains)
    for (i, j), value in zip([(0, 1), (0, 2), (1, 2)], mixed, strict=True):
        M[i, j] = M[j, i] = value
    made = sensor("m", R, R.T @ M @ R)  # C = M R
    export = export_of(calibration(made), not_reducible, "lidar", {})
    node = YAML(typ="safe").load(bias_scale_text(export))["imu_filter_madgwick"]["ros__parameters"]
    bias, scale = (np.array([node[f"mag_{w}_{a}"] for a in "xyz"]) for w in ("bias", "scale"))
    b = Rotation.random(400, rng=1).apply([0, 0, 1])  # in the sensor's axes
    reading = 1e-6 * (b @ R @ made.distortion.C.T + made.distortion.H)
    kept = reduced(made)
    # 1e-9: the offset, 7 uT, and readings of 1 uT in double precision
    alone = 1e6 * (reading - bias)
    error = np.linalg.norm(alone * scale - b, axis=1)
    assert error.max() <= kept.lost + 1e-9
    cosine = np.sum(alone * b, axis=1) / np.linalg.norm(alone, axis=1)
    assert np.sqrt(1 - np.minimum(cosine, 1) ** 2).max() <= kept.lost_without_scale + 1e-7
    if kept.lost > 1e-6:
        assert error.max() > 0.5 * kept.lost  # the bound is not idle


def test_a_matrix_that_is_not_diagonal_is_refused_with_its_size() -> None:
    P = np.array([[1.0, 0.1, 0], [0.1, 1.0, 0], [0, 0, 1.0]])
    with pytest.raises(CalibrationError, match=r"leave 10\.0% of the field wrong, 5% is allowed"):
        export_of(calibration(sensor("m", P=P)), not_reducible, "lidar", {})


def test_what_is_lost_stands_in_the_file() -> None:
    """Gains 1.2 and 0.8: the offset alone errs by asin(0.4 / 2) = 11.54 degrees."""
    moving = (MovingField("motor", np.ones(3), np.ones(3)),)
    made = sensor("m", P=np.diag([1.2, 1.0, 0.8]), moving=moving)
    export = export_of(calibration(made, sensor("n")), not_reducible, "lidar", {})
    text = bias_scale_text(export)
    assert "# lost of C, m: with bias and scale up to 0.00% of the field" in text
    assert "with the bias alone up to 11.54 deg" in text
    assert bias_scale_notes(export) == (
        "m: a program that takes the offset alone errs by up to 11.5 deg in direction",
        "m: the offset is that without what follows motor",
    )
    content = YAML(typ="safe").load(text)
    assert set(content) == {"/m/imu_filter_madgwick", "/n/imu_filter_madgwick"}
    given = content["/m/imu_filter_madgwick"]["ros__parameters"]
    assert given["mag_bias_z"] == pytest.approx(7e-6, rel=1e-12)
    assert given["mag_scale_x"] == pytest.approx(1 / 1.2, rel=1e-12)


def test_a_place_is_not_needed_for_an_offset() -> None:
    unplaced = open_in("m", slice(0, 3), "t: standstill")
    assert not_reducible(unplaced) is None
    assert len(SIGMA) == 15
