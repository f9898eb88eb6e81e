"""H of survey sensors that jumps: found in the survey, taken off its readings."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, KnownSensor, Recording
from l2m_gtsam.mapping.offset_jumps import ExplainedJump, differing
from l2m_gtsam.mapping.steady_survey import steady_survey
from l2m_gtsam.mapping.survey_jump import SurveyJump, with_more, without_jumps
from tests.drives.suite_surveys import CLOCK, QUICK, suite, surveyed
from tests.worlds.surveyed import strange_hall

JUMP_UT = np.array([0.8, -1.5, 1.0])
AT = 0.6  # of the survey
SHORT_OF = 0.1  # uT; the noise of one reading, of which hundreds are before the jump and after
CLOSE_NS = 500_000_000  # one reading is thinned out where the next is within 5 cm


@pytest.fixture(scope="module")
def survey() -> tuple[dict[str, KnownSensor], Recording]:
    sensors = suite(2, 2)
    recording = surveyed(2, sensors, strange_hall(2))
    return {each.sensor: replace(each, time_offset=-CLOCK) for each in sensors}, recording


def moment(recording: Recording) -> int:
    stamps = recording.trajectory.stamp_ns
    return int(stamps[0] + AT * (stamps[-1] - stamps[0]))


def jumping(recording: Recording, name: str, change: FloatArray) -> Recording:
    """Return a recording in which H of a sensor jumps."""
    at = moment(recording)
    series = tuple(
        replace(each, field=each.field + np.where((each.stamp_ns >= at)[:, None], change, 0.0))
        if each.sensor == name
        else each
        for each in recording.series
    )
    return replace(recording, series=series)


def changes(now: Recording, was: Recording) -> dict[str, FloatArray]:
    """Return by how much the readings of each sensor differ, uT, shape (N, 3)."""
    return {
        one.sensor: one.field - other.field
        for one, other in zip(now.series, was.series, strict=True)
    }


def test_a_jump_of_one_sensor_is_taken_off(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    known, recording = survey
    steady = steady_survey([jumping(recording, "mag_00", JUMP_UT)], known, QUICK)
    assert len(steady.doubts) == 1
    assert "H of mag_00 jumped by 2" in steady.doubts[0]
    assert "its readings after that were corrected" in steady.doubts[0]  # known is H before it
    left = changes(steady.recordings[0], recording)
    assert not left["mag_01"].any()
    away = np.abs(recording.series[0].stamp_ns - moment(recording)) > CLOSE_NS
    assert np.abs(left["mag_00"][away]).max() < SHORT_OF


def test_h_that_is_known_is_that_after_a_jump_if_it_agrees(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    known, recording = survey
    first = known["mag_00"]
    after = replace(first.distortion, H=first.distortion.H + JUMP_UT)
    late = {**known, "mag_00": replace(first, distortion=after)}
    steady = steady_survey([jumping(recording, "mag_00", JUMP_UT)], late, QUICK)
    assert len(steady.doubts) == 1
    assert "its readings before that were corrected" in steady.doubts[0]
    left = changes(steady.recordings[0], recording)["mag_00"] - JUMP_UT
    away = np.abs(recording.series[0].stamp_ns - moment(recording)) > CLOSE_NS
    assert np.abs(left[away]).max() < SHORT_OF


def test_jumps_of_all_sensors_at_once_are_taken_off(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    known, recording = survey
    loaded = jumping(jumping(recording, "mag_00", JUMP_UT), "mag_01", -0.7 * JUMP_UT[[1, 2, 0]])
    steady = steady_survey([loaded], known, QUICK)
    assert sorted(each[:11] for each in steady.doubts) == ["H of mag_00", "H of mag_01"]
    for left in changes(steady.recordings[0], recording).values():
        away = np.abs(recording.series[0].stamp_ns - moment(recording)) > CLOSE_NS
        assert np.abs(left[away]).max() < SHORT_OF


def test_what_is_left_of_a_jump_is_the_same_jump() -> None:
    one = SurveyJump("a", 100 * 10**9, JUMP_UT, right_after=False)
    more = replace(one, stamp_ns=98 * 10**9, change=0.1 * JUMP_UT)
    other = replace(one, stamp_ns=150 * 10**9)
    merged = with_more([one], [more, other])
    assert [each.stamp_ns for each in merged] == [one.stamp_ns, other.stamp_ns]
    np.testing.assert_allclose(merged[0].change, 1.1 * JUMP_UT)


def test_the_stamps_of_a_drive_are_its_own(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    """Of a jump in another drive all readings are before, or after."""
    _, recording = survey
    moved, stamps = 10**12, recording.series[0].stamp_ns
    at = int(stamps[len(stamps) // 2])
    jump = SurveyJump("mag_00", at + moved, JUMP_UT, right_after=False)
    own = changes(without_jumps(recording, [jump], moved), recording)["mag_00"]
    np.testing.assert_allclose(own, np.where((stamps >= at)[:, None], -JUMP_UT, 0.0), atol=1e-9)
    before = changes(without_jumps(recording, [jump], 0), recording)["mag_00"]
    assert not before.any()


def test_windows_differ_by_their_changes_in_sigmas() -> None:
    """By two unequal ones: (a - b)^T (A + B)^-1 (a - b), nothing if they are the same."""
    rng = np.random.default_rng(3)
    roots = rng.standard_normal((2, 3, 3))
    first, second = (root @ root.T for root in roots)
    a, b = rng.standard_normal((2, 1, 3))
    nothing = np.zeros(16)
    found = [ExplainedJump(1.0, nothing, a, first), ExplainedJump(1.0, nothing, b, second)]
    expected = float((a - b)[0] @ np.linalg.solve(first + second, (a - b)[0]))
    assert differing(found) == pytest.approx(expected, rel=1e-6)
    assert differing([found[0], found[0]]) == pytest.approx(0.0, abs=1e-9)
