"""The drives through one hall under one condition: errors, covariances and verdicts."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.errors import L2MError
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions
from l2m_gtsam.studies.troubles.surveys import TroubledHall


@dataclass(frozen=True)
class JudgedSensor:
    """What a calibration says of one sensor, and what is true.

    Attributes
    ----------
    level
        Verdict on the sensor and on what all of them share.
    distance_t, distance
        Squared distance of t, and of t, C and H, from the truth in the stated covariance; NaN as
        None where there is no result or something is not determined.
    error_m, sigma_m
        Length of the error of t, and the root of the trace of its covariance.
    unmodelled
        The largest factor of the check on parts of the drive.
    """

    level: str
    distance_t: float | None
    distance: float | None
    error_m: float | None
    sigma_m: float | None
    unmodelled: float


@dataclass(frozen=True)
class TroublesCell:
    """What came of the drives through one hall under one condition."""

    trouble: Trouble
    survey: int
    sensors: tuple[JudgedSensor, ...]


def cell_of(options: TroublesOptions, place: TroubledHall, trouble: Trouble) -> TroublesCell:
    """Calibrate and judge all drives through a hall."""
    found = [
        each
        for number in range(options.drives)
        for each in judged_drive(options, place, trouble, number)
    ]
    return TroublesCell(trouble, place.seed, tuple(found))


def judged_drive(
    options: TroublesOptions, place: TroubledHall, trouble: Trouble, number: int
) -> list[JudgedSensor]:
    """Return what the calibration of a drive says of each sensor; FAIL where there is none."""
    recording, truth = troubled_drive(options, place, trouble, number)
    stated = trouble is Trouble.POSES_STATED
    poses = PoseNoiseOptions(
        position_m=options.pose_m if stated else None,
        rotation_deg=options.pose_deg if stated else None,
        correlation_s=options.pose_s,
    )
    chosen = CalibrationOptions(solve=OneKeyOptions(pose_noise=poses))
    try:
        found = calibrated(recording, place.field_map, chosen)
        metrics = evaluate(recording, found, chosen, QaOptions())
    except L2MError:
        return [JudgedSensor(Level.FAIL.value, None, None, None, None, 1.0)] * len(truth)
    verdict = judge(found.result, metrics, QaOptions())
    return [
        judged_sensor(each, known, verdict.level)
        for each, known in zip(found.result.sensors, truth, strict=True)
    ]


def judged_sensor(found: SensorCalibration, truth: KnownSensor, level: Level) -> JudgedSensor:
    """Return what is said of a sensor beside the truth."""
    excess = found.unmodelled.largest
    covariance = found.covariance
    if not (np.isfinite(covariance).all() and np.isfinite(found.t_lidar_mag).all()):
        return JudgedSensor(level.value, None, None, None, None, excess)
    true = np.concatenate([truth.t_lidar_mag, truth.distortion.vector()])
    e = np.concatenate([found.t_lidar_mag, found.distortion.vector()]) - true
    return JudgedSensor(
        level=level.value,
        distance_t=float(e[:3] @ np.linalg.solve(covariance[:3, :3], e[:3])),
        distance=float(e @ np.linalg.solve(covariance, e)),
        error_m=float(np.linalg.norm(e[:3])),
        sigma_m=float(np.sqrt(np.trace(covariance[:3, :3]))),
        unmodelled=excess,
    )
