"""The verdict on a localisation: what speaks against it is said, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.localisation import judge_localisation, localisation_thresholds
from l2m_gtsam.records.localisation import (
    Explored,
    LocalisationStatus,
    OdometryScale,
    OdometryTurn,
    ScanUse,
)
from l2m_gtsam.records.localisation_file import (
    LocalisationRecord,
    PoseErrors,
    PoseRecord,
    SensorRecord,
    Timeline,
)
from l2m_gtsam.records.validation import ChiSquare
from l2m_gtsam.records.verdict import Level, Verdict
from tests.drives.localised import record


def judged(told: LocalisationRecord) -> Verdict:
    return judge_localisation(told, QaOptions())


def used(sensor: SensorRecord, rejected: int = 0, chi2: float = 1.0) -> SensorRecord:
    """Return a sensor of which so many of 100 readings are rejected, at no time most."""
    use = replace(sensor.use, readings=100, outside_map=0, rejected=rejected, chi2_per_dof=chi2)
    line = timed(sensor, [1] * len(sensor.timeline.used), [0] * len(sensor.timeline.used))
    return replace(sensor, use=use, timeline=line)


def timed(sensor: SensorRecord, used: list[int], rejected: list[int]) -> Timeline:
    none = (0,) * len(used)
    return Timeline(sensor.timeline.edges, tuple(used), tuple(rejected), none)


def sure(pose: PoseRecord, position: float, rotation_deg: float) -> PoseRecord:
    sigma = np.repeat([np.deg2rad(rotation_deg), position], 3)
    return replace(pose, covariance=tuple(map(tuple, np.diag(sigma**2).tolist())))


def good() -> LocalisationRecord:
    """A localisation that nothing speaks against."""
    told = record()
    assert told.truth is not None
    honest = ChiSquare(12.0, 15, 6.3, 27.5)
    return replace(
        told,
        steps=1.0,
        map_errors_shared=True,
        sensors=tuple(used(each) for each in told.sensors),
        refined=tuple(replace(each, change=honest) for each in told.refined),
        poses=tuple(sure(each, 0.02, 0.5) for each in told.poses),
        truth=replace(
            told.truth,
            nees=6.0,
            odometry=PoseErrors(0.2, 0.4, 1.0, 2.0),
            localised=PoseErrors(0.05, 0.1, 0.5, 1.0),
        ),
    )


def texts(verdict: Verdict, level: Level) -> list[str]:
    reasons = [*verdict.reasons, *(each for s in verdict.sensors for each in s.reasons)]
    return [each.text for each in reasons if each.level is level]


def test_a_hint_is_shown_and_is_no_warning() -> None:
    """Of what options would make poses better."""
    verdict = judged(replace(good(), hints=("Say more of odometry.",)))
    assert verdict.level is Level.PASS
    assert "Say more of odometry." in texts(verdict, Level.PASS)


def test_nothing_speaks_against_a_good_one() -> None:
    verdict = judged(good())
    assert verdict.level is Level.PASS
    assert texts(verdict, Level.WARN) == texts(verdict, Level.FAIL) == []
    gone = "Against the truth, 75% of odometry's error is gone: 200 mm rms of odometry alone, 50 mm"
    assert any(each.startswith(gone) for each in texts(verdict, Level.PASS))


def test_the_ending_counts() -> None:
    stopped = replace(good(), status=LocalisationStatus.NOT_CONVERGED, message="too many steps.")
    verdict = judged(stopped)
    assert verdict.level is Level.FAIL
    assert "did not converge (too many steps)" in texts(verdict, Level.FAIL)[0]
    elsewhere = replace(good(), status=LocalisationStatus.NOT_HERE, message="another place")
    assert texts(judged(elsewhere), Level.FAIL) == ["Another place."]


@pytest.mark.parametrize(
    ("position", "rotation", "level", "told"),
    [
        (0.2, 0.5, Level.WARN, "The position is known to no better than 200 mm (1 sigma) at worst"),
        (0.7, 0.5, Level.FAIL, "and to no better than 100 mm for 50% of the path"),
        (0.02, 3.0, Level.WARN, "The heading is known to no better than 3.0°"),
        (0.02, 12.0, Level.FAIL, "and to no better than 2° for 50% of the path"),
    ],
)
def test_poses_of_large_sigmas_are_named(
    position: float, rotation: float, level: Level, told: str
) -> None:
    start = good()
    way = np.array([each.p for each in start.poses])
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    half = int(np.argmin(np.abs(way - way[-1] / 2)))
    poses = [
        sure(each, position, rotation) if k > half else each for k, each in enumerate(start.poses)
    ]
    verdict = judged(replace(start, poses=tuple(poses)))
    assert verdict.level is level
    (text,) = texts(verdict, level)
    # Half of the path but for a key pose's: 20 cm of five metres.
    share = [f"{percent}% of the path" for percent in range(46, 55)]
    assert told.replace("50% of the path", "") in text
    assert any(each in text for each in share)


def test_odometry_that_does_not_fit_is_named() -> None:
    (text,) = texts(judged(replace(good(), steps=3.0)), Level.WARN)
    assert "differ from odometry's by 3.0 times" in text
    assert judged(replace(good(), steps=5.0)).level is Level.FAIL


def test_the_truth_counts() -> None:
    truth = good().truth
    assert truth is not None
    (text,) = texts(judged(replace(good(), truth=replace(truth, nees=36.0))), Level.WARN)
    assert "2.4 times their standard deviations (NEES 36.0; consistent: expected 6)" in text
    worse = replace(truth, odometry=truth.localised, localised=truth.odometry)
    (text,) = texts(judged(replace(good(), truth=worse)), Level.WARN)
    assert "made the error of the position larger" in text
    exact = replace(truth.odometry, rms_m=0.0)
    same = judged(replace(good(), truth=replace(truth, odometry=exact, localised=exact)))
    assert any(
        "Against the truth, 0 mm rms of odometry" in each for each in texts(same, Level.PASS)
    )
    lies = judged(replace(good(), truth=replace(truth, nees=70.0)))
    assert lies.level is Level.FAIL


def test_a_bad_sensor_beside_a_good_one_is_a_warning_for_the_whole() -> None:
    first, second = good().sensors
    verdict = judged(replace(good(), sensors=(used(first, rejected=60), second)))
    assert [each.level for each in verdict.sensors] == [Level.FAIL, Level.PASS]
    assert verdict.level is Level.WARN
    assert "60% of its readings inside the map do not fit it" in texts(verdict, Level.FAIL)[0]
    assert judged(replace(good(), sensors=(used(first, rejected=60),))).level is Level.FAIL
    (text,) = texts(judged(replace(good(), sensors=(used(first, rejected=100),))), Level.FAIL)
    assert text == "None of its 100 readings counts."
    noisy = judged(replace(good(), sensors=(first, used(second, chi2=2.25))))
    assert "1.5 times as large as noise and map" in texts(noisy, Level.WARN)[0]


def test_a_drive_without_a_map_is_not_told_of_one() -> None:
    explored = replace(good(), explored=Explored(3, 0.5))
    first, second = explored.sensors
    noisy = replace(explored, sensors=(used(first, rejected=60), used(second, chi2=4.0)))
    fit, noise = texts(judged(noisy), Level.FAIL)[0], texts(judged(noisy), Level.WARN)[-1]
    assert fit.startswith("60% of its readings do not fit the field of the others")
    assert noise.startswith("Its residuals are 2.0 times as large as noise and the estimated field")
    assert "its noise is stated too small" in noise
    assert "map" not in fit + noise


def test_a_place_that_changed_is_told_once_for_all_sensors() -> None:
    start = good()
    first, second = start.sensors
    count = len(first.timeline.used)
    wrong, none = [0, 9, 0, 9, 4, *[0] * (count - 5)], [0] * count
    right = [9, 1, 0, 1, 5, *[9] * (count - 5)]  # and nothing is read between
    silent = [9, 0, 0, 0, 5, *[9] * (count - 5)]  # reads nothing where the other is wrong
    seen = replace(first, timeline=timed(first, right, wrong))
    both = replace(start, sensors=(seen, replace(second, timeline=timed(second, silent, none))))
    (text,) = texts(judged(both), Level.WARN)
    low, high = (first.timeline.edges[k] for k in (1, 4))
    assert text.startswith(f"From {low:.0f} to {high:.0f} s, between (")
    assert "the place has changed since it was mapped, or something passed by" in text
    # The other sensor fits there, or there is no other: then it may be the sensor.
    fits = replace(start, sensors=(seen, second))
    assert judged(fits).level is judged(replace(start, sensors=(seen,))).level is Level.PASS


def test_a_wrong_start_is_reported() -> None:
    start = good()
    away = np.array([0.6, 0.0, 0.0])
    poses = tuple(replace(each, p=tuple(np.add(each.p, away))) for each in start.poses)
    (text,) = texts(judged(replace(start, poses=poses)), Level.WARN)
    apart = np.linalg.norm(np.add(start.poses[0].p, away) - start.odometry[0].p)
    assert f"The drive begins {apart:.2f} m and" in text


def test_what_sigmas_leave_out_is_reported() -> None:
    blind = judged(replace(good(), map_errors_shared=False))
    assert "standard deviations come out too small" in texts(blind, Level.WARN)[0]
    fixed = judged(replace(good(), refined=()))
    assert fixed.level is Level.PASS
    assert any("calibration is fixed" in each for each in texts(fixed, Level.PASS))
    nothing = tuple(replace(each, covariance=None) for each in good().poses)
    unknown = judged(replace(good(), poses=nothing))
    assert texts(unknown, Level.WARN) == ["The uncertainty of the poses is not known."]
    noted = judged(replace(good(), notes=("mag_02 is left out: it has no calibration",)))
    assert texts(noted, Level.WARN) == ["mag_02 is left out: it has no calibration."]


def test_a_calibration_that_was_not_as_sure_as_it_said_is_named() -> None:
    off = tuple(replace(each, change=replace(each.change, value=60.0)) for each in good().refined)
    found = texts(judged(replace(good(), refined=off)), Level.WARN)
    assert len(found) == 2
    assert "(60 for 15 parameters, normalised and squared)" in found[0]


def test_thresholds_are_those_of_the_options() -> None:
    named = {each.name: each for each in localisation_thresholds(QaOptions())}
    assert {"rejected", "outside_map", "chi_square", "slam.position_sigma_m", "slam.nees"} <= set(
        named
    )
    assert named["slam.position_sigma_m"].warn == 0.1
    assert "metres" in named["slam.position_sigma_m"].text


def test_a_scale_that_was_found_is_reported() -> None:
    """As what ways are; where it is no variable nothing is said of it."""
    shorter = replace(good(), scale=OdometryScale(-0.0111, 0.0018))
    told = "Distances are 1.11 ± 0.18% (1 sigma) shorter than odometry's."
    assert told in texts(judged(shorter), Level.PASS)
    longer = replace(good(), scale=OdometryScale(0.02, 0.001))
    assert any(
        "2.00 ± 0.10% (1 sigma) longer" in each for each in texts(judged(longer), Level.PASS)
    )
    assert not any("Distances are" in each for each in texts(judged(good()), Level.PASS))


def test_a_turning_that_was_found_is_reported() -> None:
    """Where it is no variable nothing is said of it."""
    right = replace(good(), turn=OdometryTurn(-0.2113, 0.0048))
    told = "Odometry turns by 0.2113 ± 0.0048 deg (1 sigma) per metre too far to the right"
    assert any(each.startswith(told) for each in texts(judged(right), Level.PASS))
    left = replace(good(), turn=OdometryTurn(0.2, 0.01))
    assert any("far to the left" in each for each in texts(judged(left), Level.PASS))
    assert not any("Odometry turns" in each for each in texts(judged(good()), Level.PASS))


def test_scans_that_contradict_odometry_are_told() -> None:
    few = ScanUse(fixes=90, loops=0, rejected=10, chi2_per_dof=1.0)
    assert judged(replace(good(), scans=few)).level is Level.PASS
    many = judged(replace(good(), scans=replace(few, fixes=60, rejected=40)))
    assert many.level is Level.WARN
    assert any("40 of 100 scan registrations" in each.text for each in many.reasons)
    none = judged(replace(good(), scans=ScanUse(0, 0, 12, float("nan"))))
    assert none.level is Level.FAIL


def test_poses_that_are_not_where_scans_say_are_told() -> None:
    scans = ScanUse(fixes=90, loops=0, rejected=0, chi2_per_dof=4.5)
    told = judged(replace(good(), scans=scans))
    assert told.level is Level.FAIL
    assert any("4.5 times the variance" in each.text for each in told.reasons)
