"""A process of a drive is a warning where it has a share in what is not known."""

from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.qa.verdict.uncertainty import disturbance_reasons, stated_wrongly
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.error_budget import (
    Disturbance,
    DisturbanceKind,
    DurationSource,
    ErrorCause,
    PoseDuration,
    StatedSize,
    Unmodelled,
    VarianceShare,
)
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.record_files import read_metrics

FILE = Path(__file__).parents[2] / "files" / "calibration.yaml"


def with_share(share: float | None) -> CalibrationResult:
    """Return a calibration with a field that has a share of H's variance; None if none is told."""
    found = Disturbance(DisturbanceKind.FIELD, {"noise_ut": 0.01}, gain=20.0)
    result = replace(read_calibration(FILE), disturbances=(found,))
    if share is None:
        return result
    shares = (
        VarianceShare(ErrorCause.NOISE, t=1.0, C=1.0, H=1.0 - share),
        VarianceShare(ErrorCause.FIELD, t=0.0, C=0.0, H=share),
    )
    sensors = tuple(replace(each, variance_shares=shares) for each in result.sensors)
    return replace(result, sensors=sensors)


@pytest.mark.parametrize(
    ("share", "level"), [(0.05, Level.PASS), (0.3, Level.WARN), (None, Level.WARN)]
)
def test_only_a_share_in_a_variance_is_a_warning(share: float | None, level: Level) -> None:
    (reason,) = disturbance_reasons(with_share(share), None)
    assert reason.level is level
    assert "steel or currents" in reason.text


def test_what_disturbed_one_sensor_is_said_of_it_alone() -> None:
    result = read_calibration(FILE)
    one, *others = (each.sensor for each in result.sensors)
    found = Disturbance(DisturbanceKind.WANDER, {"walk_ut": 0.3}, gain=50.0, sensor=one)
    result = replace(result, disturbances=(found,))
    assert len(disturbance_reasons(result, one)) == 1
    assert not [each for name in (None, *others) for each in disturbance_reasons(result, name)]


@pytest.mark.parametrize(("size", "level"), [(0.05, Level.PASS), (0.5, Level.WARN)])
def test_what_steers_matters_beside_the_sigma_of_H(size: float, level: Level) -> None:
    result = read_calibration(FILE)
    name = result.sensors[0].sensor
    steering = {"steering_ut": size * float(result[name].H_sigma.min())}
    found = Disturbance(DisturbanceKind.MOVING_PARTS, steering, gain=50.0, sensor=name)
    (reason,) = disturbance_reasons(replace(with_share(0.05), disturbances=(found,)), name)
    assert reason.level is level


def test_what_is_unmodelled_does_not_hide_what_moves() -> None:
    """Sigmas are larger by what a stand-in misses: it must not matter less for that."""
    result = read_calibration(FILE)
    first, *others = result.sensors
    shares = (
        VarianceShare(ErrorCause.NOISE, t=0.2, C=0.2, H=0.2),
        VarianceShare(ErrorCause.UNMODELLED, t=0.8, C=0.8, H=0.8),
    )
    turning = {"turning_ut": 0.09 * float(first.H_sigma.min())}
    found = Disturbance(DisturbanceKind.MOVING_PARTS, turning, gain=50.0, sensor=first.sensor)
    sensors = (replace(first, variance_shares=shares), *others)
    result = replace(result, sensors=sensors, disturbances=(found,))
    (reason,) = disturbance_reasons(result, first.sensor)
    assert reason.level is Level.WARN
    explained = replace(first, variance_shares=shares[:1])
    (reason,) = disturbance_reasons(replace(result, sensors=(explained, *others)), first.sensor)
    assert reason.level is Level.PASS


def test_what_moves_is_named_as_the_cause_of_what_is_unmodelled() -> None:
    result, metrics = read_calibration(FILE), read_metrics(FILE.with_name("metrics.json"))
    first, *others = result.sensors
    scattered = replace(first, unmodelled=Unmodelled(t=4.0, H=4.0))
    result = replace(result, sensors=(scattered, *others))
    moving = Disturbance(DisturbanceKind.MOVING_PARTS, {"turning_ut": 1.0}, 50.0, first.sensor)
    for found, words in (((), "an offset H that drifts"), ((moving,), "The likely cause: its H")):
        verdict = judge(replace(result, disturbances=found), metrics, QaOptions())
        (own,) = (each for each in verdict.sensors if each.sensor == first.sensor)
        assert any(words in each.text for each in own.reasons)


@pytest.mark.parametrize(("size", "fails"), [(0.02, False), (1.2, True)])
def test_a_frame_that_is_bent_by_more_than_half_a_metre_is_of_another_place(
    size: float, fails: bool
) -> None:
    found = Disturbance(DisturbanceKind.WARP, {"shift_m": size}, gain=500.0)
    result = replace(read_calibration(FILE), disturbances=(found,))
    metrics = read_metrics(FILE.with_name("metrics.json"))
    told = judge(result, metrics, QaOptions()).reasons
    of_bend = [each for each in told if "Is it the map of this place" in each.text]
    assert [each.level for each in of_bend] == ([Level.FAIL] if fails else [])
    assert (told == tuple(of_bend)) is fails


def test_sizes_of_errors_of_poses_are_told_with_the_duration_that_is_assumed() -> None:
    """Errors that last shorter have less in common, as smaller ones have."""
    too_large = [StatedSize(ErrorCause.POSES, ratio=0.2, gain=100.0)]
    (assumed,) = stated_wrongly(too_large, None, PoseDuration(1.0, DurationSource.ASSUMED))
    assert "too large for errors that last 1 s, as is assumed" in assumed.text
    assert "correlation_s" in assumed.text
    (known,) = stated_wrongly(too_large, None, PoseDuration(1.0, DurationSource.GIVEN))
    assert "assumed" not in known.text
    assert not stated_wrongly(too_large, "mag", None)


def test_errors_of_poses_that_one_sensor_shows_are_said_of_it() -> None:
    """Poses are not to be corrected then."""
    of_one = [StatedSize(ErrorCause.POSES, ratio=2.4, gain=100.0, sensor="mag")]
    assert not stated_wrongly(of_one, None, None)
    (reason,) = stated_wrongly(of_one, "mag", None)
    assert reason.text.startswith("mag alone shows errors of poses 2.4 times as large as stated")
    assert "bag.regressors" in reason.text
    assert "pose_noise" not in reason.text
