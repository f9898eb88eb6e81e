"""Sigmas of noise and poses that are stated wrongly are noticed, a third and thrice."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Recording
from l2m_gtsam.qa.verdict.uncertainty import stated_wrongly
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import CalibrationResult, SensorStatus
from l2m_gtsam.records.error_budget import ErrorCause, StatedSize
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble
from tests.drives.troubled import DRIVE, OPTIONS, hall, starts


def calibration(times: float, cause: ErrorCause) -> CalibrationResult:
    """Return that of a drive whose noise or poses are stated so many times too large."""
    place = hall(Trouble.CLEAN)
    if cause is ErrorCause.NOISE:
        solve, trouble = OneKeyOptions(sensor_noise_ut=times * OPTIONS.noise), Trouble.CLEAN
    else:
        poses = PoseNoiseOptions(
            position_m=times * OPTIONS.pose_m,
            rotation_deg=times * OPTIONS.pose_deg,
            correlation_s=OPTIONS.pose_s,
        )
        solve, trouble = OneKeyOptions(pose_noise=poses), Trouble.POSES
    recording, truth = troubled_drive(OPTIONS, place, trouble, DRIVE)
    options = CalibrationOptions(start=starts(truth), solve=solve)
    return calibrated(recording, place.field_map, options).result


def found(times: float, cause: ErrorCause) -> list[StatedSize]:
    """Return the sizes of such a drive."""
    return [each for each in calibration(times, cause).stated if each.cause is cause]


@pytest.mark.parametrize("cause", [ErrorCause.NOISE, ErrorCause.POSES])
def test_what_is_stated_rightly_is_not_noted(cause: ErrorCause) -> None:
    sizes = found(1.0, cause)
    assert sizes
    assert not [note for each in sizes for note in stated_wrongly([each], each.sensor, None)]


@pytest.mark.parametrize(
    ("times", "words", "cause"),
    [
        (3.0, "too large", ErrorCause.NOISE),
        (1 / 3, "too small", ErrorCause.POSES),
        (3.0, "too large", ErrorCause.POSES),
        (1 / 3, "too small", ErrorCause.NOISE),
    ],
)
def test_what_is_stated_wrongly_is_noted(times: float, words: str, cause: ErrorCause) -> None:
    result = calibration(times, cause)
    # Where stated errors leave no noise, no process is found in what rounding leaves.
    assert all(each.status is SensorStatus.SOLVED for each in result.sensors)
    sizes = [each for each in result.stated if each.cause is cause]
    assert sizes
    notes = [note for each in sizes for note in stated_wrongly([each], each.sensor, None)]
    assert len(notes) == len(sizes)
    assert all(words in each.text for each in notes)


def test_noise_stated_too_small_is_no_process_and_counts_as_the_readings_show_it() -> None:
    result, without = calibration(1 / 3, ErrorCause.NOISE), calibration(1.0, ErrorCause.NOISE)
    assert result.disturbances == ()
    for each, right in zip(result.sensors, without.sensors, strict=True):
        # Noise of 1,200 values is known to 2 %; from other weights the solve ends a trifle off.
        assert each.noise == pytest.approx(OPTIONS.noise, rel=0.1)
        assert each.t_sigma == pytest.approx(right.t_sigma, rel=0.1)


def with_a_current(recording: Recording) -> Recording:
    """Return a drive on which a motor next to the first sensor turns the vehicle: 0.7 uT."""
    (first, *others), way = recording.series, recording.trajectory
    seconds = 1e-9 * (way.stamp_ns - first.stamp_ns[0])
    rate = np.gradient(np.unwrap(np.arctan2(way.R[:, 1, 0], way.R[:, 0, 0])), seconds)
    load = np.abs(np.interp(1e-9 * (first.stamp_ns - first.stamp_ns[0]), seconds, rate))
    added = 0.7 * (load / load.std())[:, None] * [0.5, -0.7, 0.5]
    return replace(recording, series=(replace(first, field=first.field + added), *others))


def test_poses_are_not_blamed_for_what_one_sensor_shows() -> None:
    """They are as good as stated: a current next to one of two sensors looks otherwise."""
    place = hall(Trouble.CLEAN)
    recording, truth = troubled_drive(OPTIONS, place, Trouble.CLEAN, DRIVE)
    poses = PoseNoiseOptions(position_m=0.002, rotation_deg=0.05, correlation_s=OPTIONS.pose_s)
    options = CalibrationOptions(start=starts(truth), solve=OneKeyOptions(pose_noise=poses))
    result = calibrated(with_a_current(recording), place.field_map, options).result
    name = recording.series[0].sensor
    (size,) = (each for each in result.stated if each.cause is ErrorCause.POSES)
    assert size.is_wrong
    assert size.ratio > 1
    assert size.sensor == name
    assert not stated_wrongly(result.stated, None, None)
    (reason,) = stated_wrongly(result.stated, name, None)
    assert "alone shows errors of poses" in reason.text


def test_poses_are_blamed_for_what_all_sensors_show() -> None:
    """Errors of poses that are stated a third of what they are, and the same current."""
    place, times = hall(Trouble.CLEAN), 1 / 3
    recording, truth = troubled_drive(OPTIONS, place, Trouble.POSES, DRIVE)
    poses = PoseNoiseOptions(
        position_m=times * OPTIONS.pose_m,
        rotation_deg=times * OPTIONS.pose_deg,
        correlation_s=OPTIONS.pose_s,
    )
    options = CalibrationOptions(start=starts(truth), solve=OneKeyOptions(pose_noise=poses))
    result = calibrated(with_a_current(recording), place.field_map, options).result
    (size,) = (each for each in result.stated if each.cause is ErrorCause.POSES)
    assert size.is_wrong
    assert size.ratio > 1
    assert size.sensor is None
    assert any(each.sensor == recording.series[0].sensor for each in result.disturbances)
