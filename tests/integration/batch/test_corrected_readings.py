"""Readings of a bag, corrected in its copy."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.errors import BagError, CalibrationError, ConfigError, L2MError
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.records.sensor_models import MovingField
from l2m_gtsam.storage import calibrated_topics
from tests.drives.bag_copies import (
    START,
    STEP,
    TURN,
    VERDICT,
    applied,
    calibrated,
    content,
    entries,
    made,
    readings,
)
from tests.drives.bags import KINDS, Entry, ros, write
from tests.drives.calibrations import calibration, sensor, unsolved


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
