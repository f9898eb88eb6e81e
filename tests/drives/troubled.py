"""Drives with troubles in one small hall, calibrated once for all tests."""

from functools import cache

from l2m_gtsam.calibration.calibrate import Calibrated, calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.records.verdict import Verdict
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World
from l2m_gtsam.studies.troubles.surveys import TroubledPlace, troubled_place

OPTIONS = TroublesOptions(surveys=2, drives=1, survey_readings=900, readings=400)
DRIVE = 1


@cache
def hall(trouble: Trouble) -> TroubledPlace:
    return troubled_place(OPTIONS, World.HALL, trouble, 0)


@cache
def drive(trouble: Trouble) -> tuple[Calibrated, tuple[KnownSensor, ...], Verdict]:
    place = hall(Trouble.SUITE if trouble.wrong_suite else Trouble.CLEAN)
    recording, truth = troubled_drive(OPTIONS, place, trouble, DRIVE)
    found = calibrated(recording, place.field_map, CalibrationOptions())
    metrics = evaluate(recording, found, CalibrationOptions(), QaOptions())
    return found, truth, judge(found.result, metrics, QaOptions())
