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
from l2m_gtsam.records.error_budget import drift_share
from l2m_gtsam.records.validation import (
    CalibrationPart,
    DetectableShift,
    Displaced,
    DriveValidation,
)
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


def in_frame_displaced(recording: Recording, shift: FloatArray) -> Recording:
    """Return a drive whose poses have to be moved by this in metres, shape (3,)."""
    poses = recording.trajectory
    return replace(recording, trajectory=replace(poses, p=poses.p - shift))


def test_a_displacement_that_no_sensor_shows_by_itself_is_told() -> None:
    """Where the vehicle turns, a frame that is displaced looks like no change of a sensor."""
    shift = np.array([0.012, 0.012, 0.0])
    found = on_drive(in_frame_displaced(other_drive(), shift))
    assert found.displacement is not None
    assert found.displacement.of == (Displaced.FRAME,)
    assert_near(found.displacement.shift, found.displacement.shift_sigma, shift)


@pytest.mark.parametrize("shift", [(0.03, 0.0, 0.0), (0.0, 0.03, 0.0)])
def test_a_displacement_is_told_beside_the_errors_of_a_map(shift: tuple[float, ...]) -> None:
    options, place = hall()
    recording = changed_drive(options, place, TrueCause.NOTHING, 1).recording
    displaced = in_frame_displaced(recording, np.array(shift))
    found = validate(displaced, place.field_map, place.calibration, CalibrationOptions(), 1e-3)
    assert found.displacement is not None
    assert found.displacement.of == (Displaced.FRAME,)
    assert_near(found.displacement.shift, found.displacement.shift_sigma, np.array(shift))
    assert found.sources == ()


def test_a_single_sensor_shows_a_displaced_frame() -> None:
    shift = np.array([0.03, 0.03, 0.0])
    recording = in_frame_displaced(other_drive(), shift)
    found = on_drive(replace(recording, series=recording.series[:1]))
    assert found.displacement is not None
    assert_near(found.displacement.shift, found.displacement.shift_sigma, shift)
    assert "What is read fits if the poses are moved" in text(
        judge_validation(found, None, QaOptions())
    )


def test_what_a_drive_does_not_show_of_a_displacement_is_told() -> None:
    found = on_drive(other_drive())
    assert found.displacement is None
    assert [each.of for each in found.detectable_shifts] == [Displaced.LIDAR, Displaced.FRAME]
    assert all(0 < each.size < 0.03 for each in found.detectable_shifts)
    assert "rule out a shift" not in text(judge_validation(found, None, QaOptions()))
    blind = replace(found, detectable_shifts=(DetectableShift(Displaced.LIDAR, 0.05),))
    verdict = judge_validation(blind, None, QaOptions())
    assert verdict.level == "warn"
    assert (
        "This drive cannot rule out a shift by 30 mm of all sensors together (it shows 50 mm and "
        "more)."
    ) in text(verdict)


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


def drifting(
    recording: Recording, sensor: int, change: FloatArray, slowing: float | None = None
) -> Recording:
    """Return a drive over which H of a sensor drifts by this in uT, shape (3,).

    ``slowing`` is its time constant over the length of the drive.
    """
    series = list(recording.series)
    stamp_ns = series[sensor].stamp_ns
    share = drift_share((stamp_ns - stamp_ns.min()) / np.ptp(stamp_ns), 1.0, slowing)
    field = series[sensor].field + share[:, None] * change
    series[sensor] = replace(series[sensor], field=field)
    return replace(recording, series=tuple(series))


@pytest.mark.parametrize("change", [(0.0, 1.0, 0.0), (1.5, 1.5, 0.0)])
def test_a_drift_of_h_is_no_change_of_the_rest(change: tuple[float, ...]) -> None:
    options, place = hall()
    recording = changed_drive(options, place, TrueCause.NOTHING, 1).recording
    drifts = drifting(recording, 0, np.array(change))
    found = validate(drifts, place.field_map, place.calibration, CalibrationOptions(), 1e-3)
    (drift,) = found.drifts
    assert drift.sensor == found.sensors[0].sensor
    assert_near(drift.change, drift.sigma, np.array(change))
    assert found.jumps == ()
    assert [each.changes for each in found.sensors] == [(), ()]
    (first, second) = judge_validation(found, None, QaOptions()).sensors
    assert "Over the drive its offset H drifts by" in " ".join(e.text for e in first.reasons)
    assert not any("drifts" in each.text for each in second.reasons)


@pytest.mark.parametrize(("slowing", "size"), [(0.15, 3.0), (0.3, 1.0)])
def test_a_sensor_that_warms_up_does_not_jump(slowing: float, size: float) -> None:
    """Time constants between those that are tried."""
    options, place = hall()
    recording = changed_drive(options, place, TrueCause.NOTHING, 1).recording
    change = size * np.array([0.0, 0.6, 0.8])
    warm = drifting(recording, 0, change, slowing)
    found = validate(warm, place.field_map, place.calibration, CalibrationOptions(), 1e-3)
    (drift,) = found.drifts
    assert drift.sensor == found.sensors[0].sensor
    assert drift.time_constant_s is not None
    assert 0.5 < drift.time_constant_s / (slowing * drift.seconds) < 2
    # A constant beside the true one by a quarter leaves up to a twentieth of the drift.
    assert np.linalg.norm(drift.change - change) < 0.05 * size + 5 * np.linalg.norm(drift.sigma)
    assert found.jumps == ()
    assert [each.changes for each in found.sensors] == [(), ()]


def test_drifts_and_jumps_are_told_in_a_map_that_does_not_know_its_errors() -> None:
    """On an exact map: what else is wrong there is in the readings that do not count."""
    change, step = np.array([0.5, 0.3, 0.0]), np.array([0.5, 0.0, 0.0])
    found = on_drive(drifting(other_drive(), 0, change))
    (drift,) = found.drifts
    assert drift.sensor == "mag_0"
    assert_near(drift.change, drift.sigma, change)
    assert [each.changes for each in found.sensors] == [(), (), ()]
    recording = other_drive()
    after = np.arange(len(recording.series[1].field)) > 150
    field = recording.series[1].field + after[:, None] * step
    series = (recording.series[0], replace(recording.series[1], field=field), recording.series[2])
    found = on_drive(replace(recording, series=series))
    (jump,) = found.jumps
    assert jump.sensor == "mag_1"
    assert_near(jump.change, jump.sigma, step)
    assert [each.changes for each in found.sensors] == [(), (), ()]


def test_steel_is_no_jump() -> None:
    found = after_jumps({}, TrueCause.PLACE)
    assert not found.jumps
    assert not found.drifts
    assert found.displacement is None
    assert found.sources
