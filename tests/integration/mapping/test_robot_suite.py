"""One magnetometer of a real planar robot, calibrated from its own survey.

The recording (Solin et al., IEEE T-RO 2018) has a sensor that lags by 0.12 to 0.16 s and keeps an
offset of 3 uT; its position is the origin of the poses. A planar drive determines neither the
sensor's height nor the vertical part of H.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import (
    Distortion,
    FieldSeries,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_calibration import calibrate_suite, suite_doubts
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import SensorStatus

SENSOR = "invensense"


def robot_pass(path: Path, run: int) -> Recording:
    """Return one pass with the first of the robot's magnetometers."""
    with np.load(path, allow_pickle=False) as data:
        rows = (data["run"] == run) & data["ok"]
        at, q = data["t"][rows], data["quaternion_wxyz"][rows]
        position = data["position"][rows].astype(float)
        field = data["mag_body"][rows][:, 0].astype(float)
    # Passes follow each other by hours on a clock of their own.
    stamp_ns = (1e9 * (at - at[0])).astype(np.int64) + run * 10**13
    R = Rotation.from_quat(q, scalar_first=True).as_matrix()
    series = FieldSeries(SENSOR, f"/{SENSOR}", SENSOR, stamp_ns, field)
    source = SourceFile(f"pass{run}", str(run) * 64)
    return Recording(Trajectory(stamp_ns, R, position, "map", "lidar"), (series,), source)


@pytest.fixture(scope="module")
def survey(shared_data: Path) -> list[Recording]:
    return [robot_pass(shared_data / "aalto_robot_runs1-4.npz", run) for run in (2, 3, 4)]


def test_an_uncalibrated_sensor_is_noticed(survey: list[Recording]) -> None:
    """Its offset and lag alone, stated as they are, leave nothing to notice."""
    stated = Distortion(np.eye(3), np.array([2.87, -0.12, 0.0]))
    known = KnownSensor(SENSOR, np.zeros(3), stated, time_offset=-0.143)
    options = SuiteCalibrationOptions()
    assert "look uncalibrated" in suite_doubts(survey, None, options)[0]
    assert suite_doubts(survey, {SENSOR: known}, options) == ()


@pytest.mark.study
def test_a_planar_robot_calibrates_its_sensor(survey: list[Recording]) -> None:
    """Lag and level offset are found and the height is said to be open; 26 processor seconds."""
    result = calibrate_suite(survey, None, SuiteCalibrationOptions(), silent)
    (sensor,) = result.sensors
    assert sensor.status is SensorStatus.SOLVED
    # The sensing element may sit some millimetres beside the marker that was tracked.
    assert np.abs(sensor.t_lidar_mag[:2]).max() < 0.004
    assert sensor.time_offset is not None
    assert 0.12 < -sensor.time_offset.seconds < 0.16
    # Each pass alone has H of (2.8 to 3.0, -0.2 to 0.1) uT where C is held at the identity, which
    # is worth up to 0.5 uT here.
    assert sensor.distortion.H[:2] == pytest.approx([2.87, -0.12], abs=0.6)
    assert "t_lidar_mag z, H z" in result.doubts[0]
