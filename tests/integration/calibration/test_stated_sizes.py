"""Sigmas of noise and poses that are stated wrongly are noticed, a third and thrice."""

import pytest

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
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
