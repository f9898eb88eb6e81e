"""A sensor whose range is exceeded: the reason names it, and what is left calibrates it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import Calibrated, calibrate, calibrated
from l2m_gtsam.qa.evaluate import measured
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.qa.verdict.validation import judge_validation
from l2m_gtsam.records.calibration import SensorCalibration, SensorStatus
from l2m_gtsam.records.metrics import Measures
from l2m_gtsam.records.validation import DriveValidation
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.validation.validate import validate
from tests.drives.verdict import SENSORS, Drive, drive, with_series
from tests.support.records import assert_equal

NO_HALVES = QaOptions(halves=False)


def out_of_range(share: float) -> Drive:
    """The range of the y axis of the second sensor ends below a share of its readings."""
    whole = drive()
    field = whole.recording.series[1].field
    limit = float(np.quantile(field[:, 1], 1 - share))
    return with_series(whole, 1, np.minimum(field, [np.inf, limit, np.inf]))


@cache
def solved(share: float) -> tuple[Calibrated, Measures]:
    whole = out_of_range(share)
    found = calibrated(whole.recording, whole.field_map, whole.options)
    return found, measured(whole.recording, found, whole.options, NO_HALVES)


def away(sensor: SensorCalibration) -> float:
    """Return how far a sensor is from where it is, in sigmas."""
    truth = next(each for each in SENSORS if each.sensor == sensor.sensor)
    return float(np.abs((sensor.t_lidar_mag - truth.t_lidar_mag) / sensor.t_sigma).max())


@pytest.mark.parametrize(("share", "level"), [(0.05, Level.WARN), (0.25, Level.FAIL)])
def test_it_is_the_first_reason_and_what_is_left_is_right(share: float, level: Level) -> None:
    found, metrics = solved(share)
    sensor = found.result["mag_1"]
    assert sensor.status is SensorStatus.SOLVED
    assert max(map(away, found.result.sensors)) < 4
    verdict = judge(found.result, metrics, NO_HALVES)
    assert verdict["mag_1"].level is level
    first = verdict["mag_1"].reasons[0].text
    assert first.startswith(f"{sensor.sync.limits[0].share:.0%} of its readings along y equal the")
    assert "its range is exceeded" in first
    for other in ("mag_0", "mag_2"):
        assert verdict[other].level is Level.PASS


def test_the_file_has_it(tmp_path: Path) -> None:
    found, _ = solved(0.25)
    written = write_calibration(tmp_path / "calibration.yaml", found.result)
    again = read_calibration(tmp_path / "calibration.yaml")
    assert again["mag_1"].sync.limits
    assert_equal(again, written)


def test_with_too_little_left_the_reason_is_still_the_range() -> None:
    whole = out_of_range(0.95)
    found = calibrated(whole.recording, whole.field_map, whole.options)
    assert found.result["mag_1"].status is SensorStatus.NO_READINGS
    assert " beyond its range), at least" in found.result["mag_1"].message
    metrics = measured(whole.recording, found, whole.options, NO_HALVES)
    verdict = judge(found.result, metrics, NO_HALVES)
    assert "its range is exceeded" in verdict["mag_1"].reasons[0].text


def validation_of(share: float) -> DriveValidation:
    """Return the calibration of a sound drive tested on one out of range."""
    good, other = drive(), out_of_range(share)
    calibration = calibrate(good.recording, good.field_map, good.options)
    stamps = good.recording.trajectory.stamp_ns + 10**15
    series = tuple(replace(each, stamp_ns=stamps) for each in other.recording.series)
    poses = replace(good.recording.trajectory, stamp_ns=stamps)
    source = replace(good.recording.source, sha256="other")
    recording = replace(other.recording, trajectory=poses, series=series, source=source)
    return validate(recording, good.field_map, calibration, good.options, 1e-3)


@pytest.mark.parametrize(("share", "level"), [(0.05, Level.WARN), (0.25, Level.FAIL)])
def test_so_it_is_in_a_validation(share: float, level: Level) -> None:
    found = validation_of(share)
    verdict = judge_validation(found, None, QaOptions())
    assert verdict["mag_1"].level is level
    assert "its range is exceeded" in verdict["mag_1"].reasons[0].text
    assert verdict["mag_0"].level is Level.PASS
    assert found.sensors[1].limits[0].axis == "y"
