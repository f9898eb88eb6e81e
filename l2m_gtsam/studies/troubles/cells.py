"""The drives through one place under one condition: errors, covariances and verdicts."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import f

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.calibration.one_key import solve_by_parts
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.parts_alone import ByParts
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.errors import L2MError
from l2m_gtsam.qa.evaluate import measured
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.studies.statistics import LEVEL
from l2m_gtsam.studies.troubles.drives import troubled_drive
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World
from l2m_gtsam.studies.troubles.surveys import TroubledPlace

BLOCKS = {"t": slice(0, 3), "C": slice(3, 12), "H": slice(12, 15)}
EIGHT_PARTS = (1, 3)  # of the divisions of a drive: the longest parts by time, and by place


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
    alone
        Of t, C and H by name, whether the 95 % ellipsoid of the check on parts alone holds the
        truth, without the processes that were found; empty where errors are not shared.
    """

    level: str
    distance_t: float | None
    distance: float | None
    error_m: float | None
    sigma_m: float | None
    unmodelled: float
    alone: dict[str, bool] = field(default_factory=dict)


@dataclass(frozen=True)
class TroublesCell:
    """What came of the drives through one place under one condition."""

    world: World
    trouble: Trouble
    survey: int
    sensors: tuple[JudgedSensor, ...]


def cell_of(
    options: TroublesOptions, world: World, place: TroubledPlace, trouble: Trouble
) -> TroublesCell:
    """Calibrate and judge all drives through a place."""
    found = [
        each
        for number in range(options.drives)
        for each in judged_drive(options, place, trouble, number)
    ]
    return TroublesCell(world, trouble, place.truth.seed, tuple(found))


def judged_drive(
    options: TroublesOptions, place: TroubledPlace, trouble: Trouble, number: int
) -> list[JudgedSensor]:
    """Return what the calibration of a drive says of each sensor; FAIL where there is none."""
    recording, truth = troubled_drive(options, place, trouble, number)
    unstated = PoseNoiseOptions(correlation_s=options.pose_s)
    poses = options.pose_noise if trouble is Trouble.POSES_STATED else unstated
    chosen = CalibrationOptions(solve=OneKeyOptions(pose_noise=poses))
    try:
        found = calibrated(recording, place.field_map, chosen)
        measures = measured(recording, found, chosen, QaOptions())
    except L2MError:
        return [JudgedSensor(Level.FAIL.value, None, None, None, None, 1.0)] * len(truth)
    verdict = judge(found.result, measures, QaOptions())
    judged = [
        judged_sensor(each, known, verdict.level)
        for each, known in zip(found.result.sensors, truth, strict=True)
    ]
    solution = found.solution
    for each in solve_by_parts(
        solution.readings, found.solver_map, solution.estimate.t, chosen.solve
    ):
        if judged[each.sensor].distance is not None:
            alone = held_alone(each, truth[each.sensor])
            judged[each.sensor] = replace(judged[each.sensor], alone=alone)
    return judged


def judged_sensor(found: SensorCalibration, truth: KnownSensor, level: Level) -> JudgedSensor:
    """Return what is said of a sensor beside the truth."""
    excess = found.unmodelled.largest
    covariance = found.covariance
    if not (np.isfinite(covariance).all() and np.isfinite(found.t_lidar_mag).all()):
        return JudgedSensor(level.value, None, None, None, None, excess)
    e = found.vector() - truth.vector()
    return JudgedSensor(
        level=level.value,
        distance_t=float(e[:3] @ np.linalg.solve(covariance[:3, :3], e[:3])),
        distance=float(e @ np.linalg.solve(covariance, e)),
        error_m=float(np.linalg.norm(e[:3])),
        sigma_m=float(np.sqrt(np.trace(covariance[:3, :3]))),
        unmodelled=excess,
    )


def held_alone(alone: ByParts, truth: KnownSensor) -> dict[str, bool]:
    """Return whether the 95 % ellipsoids of the check alone hold t, C and H.

    The variance is that of eight parts by time or by place, whichever scatter more, as errors
    last in one or the other; it is known by few parts and few directions, whence Fisher's
    distribution.
    """
    e, P, held = alone.vector - truth.vector(), alone.covariance, dict[str, bool]()
    for name, at in BLOCKS.items():
        ratio = max((alone.ratios[name][k] for k in EIGHT_PARTS), key=lambda each: each.value)
        limit = len(e[at]) * f.ppf(LEVEL, ratio.directions, ratio.freedom)
        held[name] = bool(e[at] @ np.linalg.solve(P[at, at], e[at]) / ratio.value <= limit)
    return held
