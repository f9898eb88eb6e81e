"""The figures of one sensor that was tested on another drive than its calibration's."""

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import IntArray, SourceFile, same_content
from l2m_gtsam.maps.field_map import Summarised
from l2m_gtsam.qa.metrics.changes import change_of
from l2m_gtsam.qa.metrics.coordinates import COLUMNS, PARAMETERS, columns_of, width
from l2m_gtsam.qa.metrics.evidence import DriveEvidence, sensor_evidence
from l2m_gtsam.qa.metrics.fit import curves, field_error, fit_figures, series
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.records.validation import (
    CalibrationChange,
    ChiSquare,
    MinimumDetectableChange,
    ValidatedSensor,
)
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.solve.chi_square import chance_beyond, quantile
from l2m_gtsam.solve.closed_form import refitted
from l2m_gtsam.validation.innovation import detectable_change, knows_its_errors
from l2m_gtsam.validation.recheck import Recheck, SensorDrive

BAND = np.array([0.025, 0.975])


@dataclass(frozen=True)
class Thinning:
    """What is kept of a drive: since when, shape (1,), and how many readings at most."""

    start_ns: IntArray
    most: int


def offset_s(sensor: SensorCalibration) -> float:
    """Return the time offset of a sensor in seconds; zero if its file has none."""
    return 0.0 if sensor.time_offset is None else sensor.time_offset.seconds


def sensor_figures(
    drive: SensorDrive,
    sensor: SensorCalibration,
    found: Recheck,
    thinning: Thinning,
    chance: float,
) -> ValidatedSensor:
    """Return the figures of one sensor.

    Parameters
    ----------
    drive
        Its readings.
    sensor
        Its calibration.
    found
        The test of that on the drive.
    thinning
        How much of the drive is kept.
    chance
        Of the test.
    """
    within = drive.inside()
    seen = DriveEvidence(drive.timed, within, within & ~found.used)
    evidence = sensor_evidence(seen, sensor, drive.field_map)
    used, fields = evidence.used, curves(evidence, sensor)
    fit = fit_figures(evidence, sensor.noise)
    likelihood, freedom = found.likelihood, found.freedom
    return ValidatedSensor(
        sensor=sensor.sensor,
        ending="" if sensor.status is SensorStatus.SOLVED else sensor.message,
        readings=int(used.sum()),
        rejected=int(np.sum(~used)),
        outside=int(np.sum(~within)),
        before=field_error(fields.before[used], fields.map[used]),
        after=field_error(fields.after[used], fields.map[used]),
        expected=float(np.sqrt(fit.sensor_noise**2 + fit.map_noise**2 + fit.pose_noise**2)),
        refitted=refitted(evidence.b_lidar[used], evidence.readings.field[used]),
        uniform=fit.without_map,
        nis=_of_readings(likelihood.squared, freedom[0], sensor),
        parameters=_chi_square(likelihood.explained(range(PARAMETERS)), freedom[1]),
        changes=_changes(found),
        detectable=tuple(
            MinimumDetectableChange(part, detectable_change(likelihood, part, chance))
            for part in COLUMNS
        ),
        series=series(fields, evidence, thinning.start_ns, thinning.most),
    )


def _of_readings(value: float, freedom: int, sensor: SensorCalibration) -> ChiSquare:
    """Return the sum over readings; the noise that it counts in was itself estimated from others.

    The ratio of two estimated variances is then distributed as Fisher's F, not as chi-square.
    """
    if sensor.residuals is None:
        return _chi_square(value, freedom)
    freedom, others = max(freedom, 1), max(3 * sensor.residuals.readings - PARAMETERS, 1)
    low, high = freedom * fdtri(freedom, others, BAND)
    return ChiSquare(value, freedom, float(low), float(high))


def _chi_square(value: float, freedom: int) -> ChiSquare:
    low, high = quantile(BAND, max(freedom, 1))
    return ChiSquare(value, freedom, float(low), float(high))


def _changes(found: Recheck) -> tuple[CalibrationChange, ...]:
    """Return the changes with what chance makes of each beside the others."""
    changes = []
    for part in found.parts:
        others = [each for each in found.parts if each is not part]
        gain = found.likelihood.explained(columns_of(found.parts)) - found.likelihood.explained(
            columns_of(others)
        )
        first = len(columns_of(found.parts[: found.parts.index(part)]))
        at = slice(first, first + width(part))
        sigma = np.sqrt(np.diag(found.covariance)[at])
        chance = float(chance_beyond(gain, width(part)))
        changes.append(change_of(part, found.change[at], sigma, chance))
    return tuple(changes)


SAME_MAP = (
    "This is the map that it was calibrated with: errors of the map that the calibration took over "
    "do not show. A map of another survey would show them."
)
NO_TRACES = (
    "The calibration's file is older than poses in it: only the hash of its drive was compared, "
    "and a copy of that drive would not be recognised."
)
UNJUDGED = "The calibration was not judged: its file holds no verdict."
FAILED = "The calibration itself was judged FAIL when it was computed: calibration.yaml says why."
NOT_CORRELATED = (
    "This kind of map does not know how its errors are correlated; they count as each reading's "
    "own, and chance may be reported as a change."
)
LOWER_BOUNDS = (
    "The calibration's sigmas are lower bounds (`uncertainty: independent`): small changes may be "
    "named that are none."
)


def doubts_and_notes(
    field_map: QueryableMap, calibration: CalibrationResult, map_source: SourceFile | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what speaks against the outcome, and what is worth knowing."""
    of_map = field_map.summary.doubts if isinstance(field_map, Summarised) else ()
    doubts, notes = [f"Of the map: {each}." for each in of_map], list[str]()
    if same_content(calibration.map, map_source):
        notes.append(SAME_MAP)
    if not calibration.traces:
        notes.append(NO_TRACES)
    judged = calibration.judgement
    if judged is None:
        notes.append(UNJUDGED)
    elif judged.level is Level.FAIL:
        doubts.append(FAILED)
    if not knows_its_errors(field_map):
        notes.append(NOT_CORRELATED)
    if calibration.uncertainty is Uncertainty.INDEPENDENT:
        notes.append(LOWER_BOUNDS)
    return tuple(doubts), tuple(notes)
