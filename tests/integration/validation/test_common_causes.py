"""What all sensors of a vehicle share is told as one thing, and not sensor by sensor."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Recording
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.validation import judge_validation
from l2m_gtsam.records.validation import CalibrationPart, Displaced, DriveValidation
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.studies.validation.drives import (
    CalibratedHall,
    TrueCause,
    ValidationStudyOptions,
    calibrated_hall,
    changed_drive,
)
from l2m_gtsam.validation.validate import validate
from tests.drives.degenerate import STRONG
from tests.drives.validation import MAP, OPTIONS, calibrated, changed, other_drive
from tests.drives.verdict import SENSORS

TURN_DEG = np.array([0.5, -1.0, 2.0])
SHIFT = np.array([0.05, -0.03, 0.04])
SIGMAS = 5


def on_drive(recording: Recording) -> DriveValidation:
    return validate(recording, STRONG, calibrated(), OPTIONS, 1e-3, MAP)


def text(verdict: Verdict) -> str:
    return " ".join(verdict.lines(Level.PASS))


def moved_together(shift: FloatArray, turn_deg: FloatArray) -> tuple[KnownSensor, ...]:
    """Return the sensors after what carries them turned about their middle and was shifted."""
    R = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    middle = np.mean([each.t_lidar_mag for each in SENSORS], axis=0)
    return tuple(
        replace(
            each,
            t_lidar_mag=middle + R @ (each.t_lidar_mag - middle) + shift,
            distortion=Distortion(each.distortion.C @ R.T, each.distortion.H),
        )
        for each in SENSORS
    )


def assert_near(found: Sequence[float], sigma: Sequence[float], truth: FloatArray) -> None:
    np.testing.assert_array_less(np.abs(np.array(found) - truth), SIGMAS * np.array(sigma))


def test_sensors_that_moved_together_are_told_at_once() -> None:
    found = on_drive(other_drive(moved_together(SHIFT, TURN_DEG)))
    assert found.displacement is not None
    assert found.displacement.of == (Displaced.LIDAR,)
    assert_near(found.displacement.shift, found.displacement.shift_sigma, SHIFT)
    assert_near(found.displacement.turn, found.displacement.turn_sigma, TURN_DEG)
    assert all(each.changes == () for each in found.sensors)
    verdict = judge_validation(found, None, QaOptions())
    assert "All 3 sensors together moved by" in verdict.reasons[0].text
    assert "mount of the lidar" in verdict.reasons[0].text
    assert [each.level for each in verdict.sensors] == [Level.FAIL] * 3
    assert "its mount gave way" not in text(verdict)


def test_poses_in_another_frame_are_told_at_once() -> None:
    """The sensors are as calibrated: their tests are those of poses that were moved back."""
    recording = other_drive()
    poses, R = recording.trajectory, Rotation.from_rotvec([0, 0, 1.5], degrees=True).as_matrix()
    middle = poses.p.mean(axis=0)
    elsewhere = replace(poses, R=R.T @ poses.R, p=(poses.p - SHIFT - middle) @ R + middle)
    found = on_drive(replace(recording, trajectory=elsewhere))
    assert found.displacement is not None
    assert found.displacement.of == (Displaced.FRAME,)
    assert_near(found.displacement.turn, found.displacement.turn_sigma, np.array([0, 0, 1.5]))
    assert all(each.changes == () for each in found.sensors)
    verdict = judge_validation(found, None, QaOptions())
    assert verdict.reasons[0].level is Level.WARN
    assert "their frame is not that of the map" in verdict.reasons[0].text


def test_sensors_that_moved_apart_are_told_one_by_one() -> None:
    first = changed(0, t=np.array([0.05, 0, 0]))
    second = changed(1, t=np.array([0, -0.06, 0]))
    found = on_drive(other_drive((first[0], second[1], SENSORS[2])))
    assert found.displacement is None
    parts = [[change.part for change in each.changes] for each in found.sensors]
    assert CalibrationPart.PLACE in parts[0]
    assert CalibrationPart.PLACE in parts[1]
    assert parts[2] == []


@pytest.mark.parametrize("order", [(1, 0, 2), (1, 2, 0)])
def test_exchanged_sensors_are_told(order: tuple[int, ...]) -> None:
    """Also round in a ring; one that is itself passes."""
    recording = other_drive()
    series = tuple(
        replace(recording.series[k], sensor=own.sensor)
        for k, own in zip(order, recording.series, strict=True)
    )
    found = on_drive(replace(recording, series=series))
    whose = [f"mag_{k}" if k != place else "" for place, k in enumerate(order)]
    assert [each.reads_as for each in found.sensors] == whose
    assert all(each.changes == () for each in found.sensors)
    verdict = judge_validation(found, None, QaOptions())
    assert "map does not fit" not in text(verdict)
    for other, sensor in zip(whose, verdict.sensors, strict=True):
        told = f"fit the calibration of {other}, not its own" in text(verdict)
        assert (sensor.level is Level.FAIL and told) == bool(other)


def test_a_sensor_that_is_broken_is_not_exchanged() -> None:
    recording = other_drive()
    noise = np.random.default_rng(5).normal(0, 30, (300, 3))
    broken = replace(recording.series[0], field=recording.series[0].field + noise)
    moved = replace(recording.series[1], field=recording.series[1].field * 1.5)
    found = on_drive(replace(recording, series=(broken, moved, recording.series[2])))
    assert [each.reads_as for each in found.sensors] == ["", "", ""]


@cache
def hall() -> tuple[ValidationStudyOptions, CalibratedHall]:
    options = ValidationStudyOptions(survey_readings=600, readings=200, sensors=2)
    return options, calibrated_hall(options, 0)


def after_jumps(
    jumps: dict[int, list[tuple[int, FloatArray]]], cause: TrueCause
) -> DriveValidation:
    """Return a test on a drive; by the number of a sensor the readings from which H is other."""
    options, place = hall()
    recording = changed_drive(options, place, cause, 1).recording
    series = list(recording.series)
    for sensor, each in jumps.items():
        field = series[sensor].field.copy()
        for first, change in each:
            field[first:] += change
        series[sensor] = replace(series[sensor], field=field)
    recording = replace(recording, series=tuple(series))
    return validate(recording, place.field_map, place.calibration, CalibrationOptions(), 1e-3)


def test_a_jump_of_h_is_no_steel() -> None:
    change = np.array([2.0, -1.0, 0.5])
    found = after_jumps({1: [(100, change)]}, TrueCause.NOTHING)
    (jump,) = found.jumps
    assert jump.sensor == found.sensors[1].sensor
    assert_near(jump.change, jump.sigma, change)
    assert found.sources == ()
    assert [each.changes for each in found.sensors] == [(), ()]
    assert all(each.nis.ratio == pytest.approx(1, abs=0.5) for each in found.sensors)
    verdict = judge_validation(found, None, QaOptions())
    assert verdict.level == verdict.sensors[1].level == "fail"
    assert "its offset H jumped by 2." in text(verdict)
    assert verdict.sensors[0].level != "fail"


def test_jumps_of_several_sensors_are_told_one_by_one() -> None:
    change = np.array([0.0, 3.0, 0.0])
    found = after_jumps({0: [(60, change)], 1: [(140, -change)]}, TrueCause.NOTHING)
    assert [each.sensor for each in found.jumps] == [each.sensor for each in found.sensors]
    assert found.sources == ()


def test_h_that_jumps_again_and_again_wanders() -> None:
    step = np.array([0.0, 3.0, 0.0])
    found = after_jumps({0: [(50, step), (100, step), (150, step)]}, TrueCause.NOTHING)
    assert len(found.jumps) == 3
    (first, _) = judge_validation(found, None, QaOptions()).sensors
    (told,) = [each.text for each in first.reasons if "offset H" in each.text]
    assert "its offset H wanders, by 9." in told or "its offset H wanders, by 8." in told


def test_steel_is_no_jump() -> None:
    found = after_jumps({}, TrueCause.PLACE)
    assert found.jumps == ()
    assert found.displacement is None
    assert found.sources
