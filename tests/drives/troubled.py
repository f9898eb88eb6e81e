"""Drives with troubles in one small hall, calibrated once for all tests of a run.

Sensors start near their places: how starts are found is not what these drives are for.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from l2m_gtsam.calibration.calibrate import Calibrated, calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.records.verdict import Verdict
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World
from l2m_gtsam.studies.troubles.surveys import TroubledPlace, troubled_place
from tests.support.kept import kept

OPTIONS = TroublesOptions(surveys=2, drives=1, survey_readings=900, readings=400)
DRIVE = 1


@cache
def hall(trouble: Trouble) -> TroubledPlace:
    return kept(f"hall-{trouble}", lambda: troubled_place(OPTIONS, World.HALL, trouble, 0))


@cache
def drive(trouble: Trouble) -> tuple[Calibrated, tuple[KnownSensor, ...], Verdict]:
    return kept(f"troubled-drive-{trouble}", lambda: _drive(trouble))


def _drive(trouble: Trouble) -> tuple[Calibrated, tuple[KnownSensor, ...], Verdict]:
    place = hall(Trouble.SUITE if trouble.wrong_suite else Trouble.CLEAN)
    recording, truth = troubled_drive(OPTIONS, place, trouble, DRIVE)
    found, verdict = judged(place, recording, truth)
    return found, truth, verdict


@cache
def drifting_clock(seconds: float) -> tuple[Calibrated, tuple[KnownSensor, ...], Verdict]:
    """Return the clean drive where the first sensor's clock drifts by so much, steadily."""
    place = hall(Trouble.CLEAN)
    recording, truth = troubled_drive(OPTIONS, place, Trouble.CLEAN, DRIVE)
    first, *others = recording.series
    u = (first.stamp_ns - first.stamp_ns[0]) / np.ptp(first.stamp_ns) - 0.5
    late = first.stamp_ns + np.round(1e9 * seconds * u).astype(np.int64)
    series = (replace(first, stamp_ns=late), *others)
    found, verdict = judged(place, replace(recording, series=series), truth)
    return found, truth, verdict


def starts(truth: Sequence[KnownSensor]) -> dict[str, tuple[float, float, float]]:
    """Return places 9 cm from those of sensors, for a solve to start from."""
    near = {each.sensor: (each.t_lidar_mag + 0.05).tolist() for each in truth}
    return {name: (x, y, z) for name, (x, y, z) in near.items()}


def judged(
    place: TroubledPlace, recording: Recording, truth: Sequence[KnownSensor]
) -> tuple[Calibrated, Verdict]:
    """Return the calibration of a drive, and the verdict on it."""
    options = CalibrationOptions(start=starts(truth))
    found = calibrated(recording, place.field_map, options)
    metrics = evaluate(recording, found, options, QaOptions())
    return found, judge(found.result, metrics, QaOptions())
