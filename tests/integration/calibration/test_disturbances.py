"""Errors that last are found on a drive, sized, and held by the sigmas: one hall, one each."""

import re
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import chi2

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import Calibrated
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.records.error_budget import Disturbance, DisturbanceKind
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble
from tests.drives.troubled import DRIVE, OPTIONS, drifting_clock, drive, hall

# Of 15 parameters of two sensors under one map; 1 of 1,000 each where sigmas are true.
WITHIN = float(chi2.ppf(0.999, 15))
DRIFT_S = 0.06  # from the start of a drive to its end


def shown(trouble: Trouble, kind: DisturbanceKind) -> list[Disturbance]:
    return [each for each in drive(trouble)[0].result.disturbances if each.kind is kind]


def distances(found: Calibrated, truth: Sequence[KnownSensor]) -> list[float]:
    """Return the squared distance of (t, C, H) of each sensor from the truth."""
    result = []
    for each, known in zip(found.result.sensors, truth, strict=True):
        e = each.t_lidar_mag - known.t_lidar_mag
        e = np.concatenate([e, each.distortion.vector() - known.distortion.vector()])
        result.append(float(e @ np.linalg.solve(each.covariance, e)))
    return result


def test_nothing_is_found_where_nothing_is() -> None:
    found, _, verdict = drive(Trouble.CLEAN)
    assert found.result.disturbances == ()
    assert verdict.level is Level.PASS


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        (Trouble.DRIFT, "H of mag_00 is not constant: it wanders by"),
        (Trouble.PINK, "H of mag_01 is not constant"),
        (Trouble.POSES, "Poses are wrong by about"),
    ],
)
def test_sigmas_hold_what_lasts_and_the_verdict_says_so(trouble: Trouble, words: str) -> None:
    found, truth, verdict = drive(trouble)
    assert max(distances(found, truth)) < WITHIN
    assert verdict.level is Level.WARN
    # Both halves have the process: that they differ by it is no second fault.
    own = [reason.text for sensor in verdict.sensors for reason in sensor.reasons]
    assert any(words in text for text in (*own, *(each.text for each in verdict.reasons)))
    assert not any("does not repeat" in text for text in own)


def said_of(verdict: Verdict, name: str, words: str) -> bool:
    """Return whether a sensor's own reasons have some words, and nobody else's have."""
    (own,) = (each for each in verdict.sensors if each.sensor == name)
    others = [*verdict.reasons, *(r for e in verdict.sensors if e is not own for r in e.reasons)]
    said = any(words in each.text for each in own.reasons)
    return said and not any(words in each.text for each in others)


def test_a_wandering_offset_is_sized() -> None:
    found = shown(Trouble.DRIFT, DisturbanceKind.WANDER)
    assert [each.sensor for each in found] == ["mag_00", "mag_01"]
    # Draws of three walks each: their size is known to a third.
    for each in found:
        assert each.sizes["walk_ut"] == pytest.approx(OPTIONS.drift_ut, rel=0.5)


def test_a_bend_that_is_not_found_is_counted_and_said() -> None:
    clean, _, verdict = drive(Trouble.CLEAN)
    size, before = clean.result.unseen_warp_m, OneKeyOptions().warp_m
    assert size is not None
    assert 0 < size < before
    assert any("frame may be bent against the map's" in each.text for each in verdict.reasons)
    # One that is found is estimated.
    assert shown(Trouble.WARP, DisturbanceKind.WARP)
    assert drive(Trouble.WARP)[0].result.unseen_warp_m is None


def test_errors_of_poses_are_sized_and_no_longer_taken_for_exact() -> None:
    (found,) = shown(Trouble.POSES, DisturbanceKind.POSES)
    assert found.sensor is None
    # Rotations are felt in tens of uT per radian everywhere, shifts where there is a gradient.
    for name in ("tilt_deg", "heading_deg"):
        assert found.sizes[name] == pytest.approx(OPTIONS.pose_deg, rel=0.5)
    assert 0.3 < found.sizes["floor_m"] / OPTIONS.pose_m < 3
    result, clean = drive(Trouble.POSES)[0].result, drive(Trouble.CLEAN)[0].result
    assert "the drive's poses" not in result.exact
    assert "the drive's poses" in clean.exact


def test_a_suite_that_is_off_is_sized_by_its_survey() -> None:
    wrong, right = (hall(each).field_map for each in (Trouble.SUITE, Trouble.CLEAN))
    assert isinstance(wrong, HarmonicMap)
    assert isinstance(right, HarmonicMap)
    assert right.learnt.suite is None
    assert wrong.learnt.suite is not None
    sigma = np.sqrt(np.diag(wrong.learnt.suite.covariance)[:15])
    # Three sensors: nine draws of t and H each, less what they have in common; 27 of C.
    assert sigma[12] == pytest.approx(OPTIONS.suite_H_ut, rel=0.7)
    assert sigma[3] == pytest.approx(OPTIONS.suite_C, rel=0.5)
    assert any("by the survey itself" in each for each in wrong.learnt.origin.survey)
    found, truth, verdict = drive(Trouble.SUITE)
    assert max(distances(found, truth)) < WITHIN
    assert verdict.level is Level.WARN


def test_a_clock_that_drifts_is_sized_and_held() -> None:
    found, truth, verdict = drifting_clock(DRIFT_S)
    clocks = [each for each in found.result.disturbances if each.kind is DisturbanceKind.CLOCK]
    assert [each.sensor for each in clocks] == ["mag_00"]
    # A steady drift is one draw of the walk that is looked for.
    assert 0.4 < clocks[0].sizes["drift_s"] / DRIFT_S < 2.5
    assert max(distances(found, truth)) < WITHIN
    assert found.result["mag_00"].unmodelled.largest == 1
    assert said_of(verdict, "mag_00", "The clock of mag_00 drifts")


def test_a_low_pass_filter_is_sized_and_held() -> None:
    found, truth, verdict = drive(Trouble.SMOOTHED)
    filters = shown(Trouble.SMOOTHED, DisturbanceKind.SMOOTHING)
    assert [each.sensor for each in filters] == ["mag_00", "mag_01"]
    for each in filters:
        # Turns begin and end within the filter's time: its higher moments make it look shorter.
        assert 0.5 < each.sizes["smoothing_s"] / OPTIONS.smoothed_s < 1.2
    for sensor in found.result.sensors:
        offset = sensor.time_offset
        assert offset is not None
        # The filter's mean delay: to three sigmas, which include what the model leaves out.
        assert abs(offset.seconds + OPTIONS.smoothed_s) < 3 * offset.sigma
    assert max(distances(found, truth)) < WITHIN
    assert said_of(verdict, "mag_00", "Readings of mag_00 are smoothed")


def test_iron_that_steers_is_found_and_held() -> None:
    found, truth, verdict = drive(Trouble.STEERING)
    moving = shown(Trouble.STEERING, DisturbanceKind.MOVING_PARTS)
    assert [each.sensor for each in moving] == ["mag_00", "mag_01"]
    for each in moving:
        steers = each.sizes["turning_ut"] + each.sizes["steering_ut"]
        assert steers > 5 * each.sizes["acceleration_ut"]
    assert max(distances(found, truth)) < WITHIN
    assert verdict.level is Level.WARN
    assert said_of(verdict, "mag_00", "H of mag_00 follows how the vehicle")


def test_a_jump_of_H_is_timed_sized_and_taken_off() -> None:
    found, truth, verdict = drive(Trouble.JUMP)
    recording, _ = troubled_drive(OPTIONS, hall(Trouble.CLEAN), Trouble.JUMP, DRIVE)
    clean, _ = troubled_drive(OPTIONS, hall(Trouble.CLEAN), Trouble.CLEAN, DRIVE)
    jumps = {each.sensor: each for each in found.result.jumps}
    assert set(jumps) == {"mag_00", "mag_01"}
    for jumped, before in zip(recording.series, clean.series, strict=True):
        change = jumped.field - before.field
        jump = jumps[jumped.sensor]
        # Of three axes 0.1 % lie beyond four sigmas.
        assert np.abs(jump.change - change[-1]).max() < 4 * max(jump.sigma)
        first = jumped.stamp_ns[np.flatnonzero(change.any(axis=1))[0]]
        # Averages are of half a second.
        assert abs(jump.stamp_ns - first) < 1e9
    # Nothing has to stand in for it: neither a walk of H nor steel.
    assert not shown(Trouble.JUMP, DisturbanceKind.WANDER)
    assert found.result.sources == ()
    assert max(distances(found, truth)) < WITHIN
    assert verdict.level is Level.WARN
    for sensor in verdict.sensors:
        told = r"s after the first reading that counts, its offset H jumped by ([\d.]+) µT"
        (size,) = re.findall(told, " ".join(reason.text for reason in sensor.reasons))
        # Each component is known to 0.03 uT, and sizes are told in tenths.
        assert float(size) == pytest.approx(OPTIONS.jump_ut, abs=0.15)


def test_an_H_that_walks_does_not_jump() -> None:
    assert drive(Trouble.DRIFT)[0].result.jumps == ()
    assert drive(Trouble.PINK)[0].result.jumps == ()
