"""Clocks of calibrated survey sensors that drift: found in the survey, taken out of its stamps."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.mapping.clock_drifts import clock_drifts, since_middle, steadied
from l2m_gtsam.mapping.seen_windows import SeenWindows
from l2m_gtsam.mapping.steady_survey import FEW, steady_survey
from l2m_gtsam.mapping.suite_drive import suite_drive
from tests.drives.suite_surveys import CLOCK, QUICK, suite, surveyed
from tests.worlds.surveyed import strange_hall

RATE = 2e-3  # 100 ms over a survey of 50 s


@pytest.fixture(scope="module")
def survey() -> tuple[dict[str, KnownSensor], Recording]:
    sensors = suite(2, 2)
    recording = surveyed(2, sensors, strange_hall(2))
    return {each.sensor: replace(each, time_offset=-CLOCK) for each in sensors}, recording


def test_a_clock_that_drifts_is_found_and_no_other(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    known, recording = survey
    off = steadied(recording, {"mag_00": -RATE})  # as if its stamps had drifted
    drive = suite_drive([off], known, QUICK)
    readings = drive.at(drive.assumed[:, -1])
    one_drive = np.zeros(len(readings), dtype=np.int64)
    seen = SeenWindows.of(readings, drive.assumed, QUICK)
    found = clock_drifts(seen, since_middle(readings.stamp_ns, one_drive))
    # Stamps that ran slow by a rate are put right by it, but for its square.
    assert found.rates[0] == pytest.approx(RATE, abs=4 * found.sigmas[0])
    assert found.rates[1] == pytest.approx(0, abs=4 * found.sigmas[1])
    assert found.sigmas.max() < 0.1 * RATE
    assert (found.found != 0).tolist() == [True, False]


def test_the_survey_gets_stamps_that_do_not_drift(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    known, recording = survey
    off = steadied(recording, {"mag_00": -RATE})
    steady = steady_survey([off], known, QUICK)
    assert len(steady.doubts) == 1
    assert "the clock of mag_00 drifts" in steady.doubts[0]
    (put_right,) = steady.recordings
    for was, wrong, now in zip(recording.series, off.series, put_right.series, strict=True):
        before, after = (np.abs(1e-9 * (each.stamp_ns - was.stamp_ns)) for each in (wrong, now))
        if was.sensor == "mag_00":
            # One step from the drifting stamps; what it leaves is a tenth.
            assert after.max() < 0.15 * before.max()
        else:
            np.testing.assert_array_equal(now.stamp_ns, was.stamp_ns)


def test_steady_clocks_are_left_alone(survey: tuple[dict[str, KnownSensor], Recording]) -> None:
    known, recording = survey
    steady = steady_survey([recording], known, QUICK)
    assert steady.doubts == ()
    (same,) = steady.recordings
    for one, other in zip(same.series, recording.series, strict=True):
        np.testing.assert_array_equal(one.stamp_ns, other.stamp_ns)


def test_a_survey_too_small_to_be_judged_is_left_as_it_is(
    survey: tuple[dict[str, KnownSensor], Recording],
) -> None:
    known, recording = survey
    few = tuple(replace(s, stamp_ns=s.stamp_ns[:5], field=s.field[:5]) for s in recording.series)
    small = replace(recording, series=few)
    assert steady_survey([small], known, QUICK).recordings[0] is small
    assert FEW["readings"] > 5


def test_time_is_counted_from_the_middle_of_each_drive() -> None:
    stamps = np.array([0, 2, 4, 100, 110], dtype=np.int64) * 10**9
    found = since_middle(stamps, np.array([0, 0, 0, 1, 1]))
    np.testing.assert_allclose(found, [-2, 0, 2, -5, 5])
