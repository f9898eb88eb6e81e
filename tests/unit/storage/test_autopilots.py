"""Parameters of autopilots: what these programs make of them is the field."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.mavparm import MAVParmDict
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.storage.exports.autopilots import (
    ardupilot_fault,
    ardupilot_text,
    autopilot_notes,
    px4_fault,
    px4_text,
)
from tests.drives.calibrations import mounted, sensor

# As PX4 defines its parameters: kind and limits of each, of up to four sensors.
PX4_DEFINITIONS = {
    **{f"{axis}OFF": (-np.inf, np.inf) for axis in "XYZ"},
    **{f"{axis}SCALE": (0.1, 3.0) for axis in "XYZ"},
    **{f"{axis}ODIAG": (-np.inf, np.inf) for axis in "XYZ"},
}
ARDUPILOT_NAMES = ("OFS", "DIA", "ODI")


def distorted(name: str, seed: int, spread: float = 0.1) -> SensorCalibration:
    """A sensor with soft iron, turned anyhow: C = P R_mag_lidar with P symmetric."""
    rng = np.random.default_rng(seed)
    half = rng.normal(scale=spread, size=(3, 3))
    P = np.eye(3) + (half + half.T) / 2
    R_mag_lidar = Rotation.random(rng=rng).as_matrix()
    H = rng.normal(scale=30, size=3)
    base = sensor(name)
    return replace(base, distortion=Distortion(P @ R_mag_lidar, H), R_lidar_mag=R_mag_lidar.T)


def read_px4(text: str) -> dict[str, float]:
    """What QGroundControl reads: five columns with tabs, `#` begins a comment."""
    found = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            vehicle, component, name, value, kind = line.split("\t")
            assert (vehicle, component, kind) == ("1", "1", "9")
            found[name] = float(np.float32(value))
    return found


def px4_field(found: dict[str, float], number: int, reading_gauss: FloatArray) -> FloatArray:
    """PX4's correction before its rotation."""
    offset, scale, odiag = (
        np.array([found[f"CAL_MAG{number}_{axis}{what}"] for axis in "XYZ"])
        for what in ("OFF", "SCALE", "ODIAG")
    )
    S = np.diag(scale)
    S[0, 1] = S[1, 0] = odiag[0]
    S[0, 2] = S[2, 0] = odiag[1]
    S[1, 2] = S[2, 1] = odiag[2]
    return np.asarray((reading_gauss - offset) @ S.T)


def ardupilot_field(found: MAVParmDict, number: int, reading_mg: FloatArray) -> FloatArray:
    """ArduPilot's correction; a factor of 0 is none."""
    index = "" if number == 0 else str(number + 1)
    offset, diagonal, beside = (
        np.array([found[f"COMPASS_{what}{index}_{axis}"] for axis in "XYZ"])
        for what in ARDUPILOT_NAMES
    )
    assert found[f"COMPASS_SCALE{index}"] == 0
    x, y, z = beside
    S = np.diag(diagonal) + np.array([[0, x, y], [x, 0, z], [y, z, 0]])
    return np.asarray((reading_mg + offset) @ S.T)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ardupilot")


@given(st.integers(0, 2**32 - 1))
def test_px4_makes_the_field_of_readings(seed: int) -> None:
    sensors = [distorted("a", seed), distorted("b", seed + 1)]
    export = mounted(sensors)
    found = read_px4(px4_text(export))
    assert len(found) == 9 * len(sensors)
    for name, value in found.items():
        low, high = PX4_DEFINITIONS[name.removeprefix("CAL_MAG")[2:]]
        assert low <= value <= high
    b_sensor = np.random.default_rng(seed).normal(scale=40, size=(20, 3))
    for number, each in enumerate(sensors):
        b_lidar = b_sensor @ each.R_lidar_mag.T
        reading = each.distortion.apply(b_lidar)
        # Numbers of single precision: a few parts in 10^7 of 100 uT.
        field = 100 * px4_field(found, number, reading / 100)
        np.testing.assert_allclose(field, b_sensor, atol=1e-3)


@given(st.integers(0, 2**32 - 1))
def test_ardupilot_makes_the_field_of_readings(folder: Path, seed: int) -> None:
    sensors = [distorted("a", seed), distorted("b", seed + 1), distorted("c", seed + 2)]
    path = folder / "compass.param"
    path.write_text(ardupilot_text(mounted(sensors)))
    found = MAVParmDict()
    assert found.load(str(path), use_excludes=False)  # the parser of ArduPilot's own tools
    assert len(found) == 10 * len(sensors)
    b_sensor = np.random.default_rng(seed).normal(scale=40, size=(20, 3))
    for number, each in enumerate(sensors):
        reading = each.distortion.apply(b_sensor @ each.R_lidar_mag.T)
        field = ardupilot_field(found, number, 10 * reading) / 10
        np.testing.assert_allclose(field, b_sensor, atol=1e-3)


def test_what_an_autopilot_cannot_hold_is_left_out() -> None:
    weak = distorted("weak", 1)
    weak = replace(weak, distortion=Distortion(weak.distortion.C / 8, weak.distortion.H))
    told = px4_fault(weak)
    assert told is not None
    assert "outside of the 0.1 to 3 that are accepted there" in told
    assert "0.2 to 5" in (ardupilot_fault(weak) or "")
    skewed = distorted("skewed", 2)
    skewed = replace(skewed, R_lidar_mag=np.eye(3))
    assert "not symmetric" in (px4_fault(skewed) or "")
    assert px4_fault(distorted("good", 3)) is None


def test_more_sensors_than_there_are() -> None:
    export = mounted([distorted(f"mag_{k}", k) for k in range(5)])
    with pytest.raises(CalibrationError, match="PX4 has 4 magnetometers, the calibration 5"):
        px4_text(export)
    with pytest.raises(CalibrationError, match="ArduPilot has 3 magnetometers"):
        ardupilot_text(export)


def test_readings_that_px4_had_corrected_are_warned_of(tmp_path: Path) -> None:
    (note,) = autopilot_notes(mounted([distorted("vehicle_magnetometer_0", 4)]))
    assert "calibrate sensor_mag" in note
    text = px4_text(mounted([distorted("mag", 4)]))
    assert "# CAL_MAG0 is mag: " in text
    assert "turned by roll" in text
