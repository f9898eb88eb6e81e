"""Recording + map + calibration -> how far the calibration still holds. Pure: no files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, f

from l2m_gtsam.config import CalibrationOptions
from l2m_gtsam.data import FloatArray, IntArray, Readings, Recording, SourceFile
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.graph.innovation import KnownCalibration, knows_its_errors
from l2m_gtsam.graph.recheck import Recheck, SensorDrive, recheck
from l2m_gtsam.graph.view import Compilable, QueryableMap
from l2m_gtsam.maps.field_map import Summarised
from l2m_gtsam.prepare import prepare
from l2m_gtsam.progress import Progress
from l2m_gtsam.qa.metrics.assemble import DRAWN, FEWEST, MOST, map_picture
from l2m_gtsam.qa.metrics.changes import change_of, is_calibrated
from l2m_gtsam.qa.metrics.coverage import drive_metrics
from l2m_gtsam.qa.metrics.curves import curves, series
from l2m_gtsam.qa.metrics.evidence import DriveEvidence, sensor_evidence
from l2m_gtsam.qa.metrics.field_error import field_error, refitted
from l2m_gtsam.qa.metrics.fit import fit_figures
from l2m_gtsam.results import CalibrationResult, SensorCalibration, SensorStatus, Uncertainty
from l2m_gtsam.solve.alterations import COLUMNS, PARAMETERS, columns_of, noticeable, width
from l2m_gtsam.solve.correction import without_moving
from l2m_gtsam.sync import stuck_sensors
from l2m_gtsam.validation_results import (
    Change,
    ChiSquare,
    DriveValidation,
    Noticeable,
    NotValidated,
    ValidatedSensor,
)

BAND = np.array([0.025, 0.975])
NOTICED_SIGMAS = 5.0  # a change of so many is missed once in a hundred times, or less often
SAME_BAG = (
    "This is the drive that the calibration was computed from: it agrees with itself. Take another."
)
SAME_MAP = (
    "This is the map that it was calibrated with: errors of the map that the calibration took over "
    "do not show. A map of another survey would show them."
)
NOT_CORRELATED = (
    "This kind of map does not know how its errors are correlated; each reading's counts as its "
    "own, so that chance is taken to do less than it does."
)
LOWER_BOUNDS = (
    "The calibration's sigmas are lower bounds (`uncertainty: independent`): small changes may be "
    "named that are none."
)


def validate(
    recording: Recording,
    field_map: QueryableMap,
    calibration: CalibrationResult,
    options: CalibrationOptions,
    chance: float,
    map_source: SourceFile | None = None,
    progress: Progress | None = None,
) -> DriveValidation:
    """Compare the readings of a drive with what map and calibration predict.

    Parameters
    ----------
    recording
        A drive through the mapped place.
    field_map
        The magnetic map, in the frame of the recording's poses.
    calibration
        To be tested.
    options
        Synchronisation, the loss, and how wrong poses are.
    chance
        Share of unchanged sensors of which it may be said that something changed.
    map_source
        Where the map came from.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    CalibrationError
        Calibration and recording have no sensor in common.
    ConfigError
        Readings follow a number that was not recorded.
    SyncError
        Readings and poses do not overlap.
    """
    tell = progress or (lambda stage, fraction: None)
    here = {each.sensor for each in recording.series}
    known = [each for each in calibration.sensors if each.sensor in here and is_sound(each)]
    missing = _missing(recording, calibration)
    if not known:
        raise CalibrationError(_nothing_shared(recording, calibration, missing))
    shared = {each.sensor for each in known}
    kept = tuple(each for each in recording.series if each.sensor in shared)
    synchronised = prepare(replace(recording, series=kept), options)
    asked = field_map.compile() if isinstance(field_map, Compilable) else field_map
    readings = synchronised.readings
    stuck = {readings.sensors[k] for k in stuck_sensors(readings)}
    start_ns = readings.stamp_ns.min(keepdims=True)
    drawn = int(np.clip(DRAWN // len(known), FEWEST, MOST))
    sensors: list[ValidatedSensor] = []
    for index, sensor in enumerate(known):
        tell("validating", index / len(known))
        drive = drive_of(readings, recording, sensor)
        if reason := _why_silent(drive, asked, sensor, options, sensor.sensor in stuck):
            missing.append(NotValidated(sensor.sensor, reason, faulty=True))
            continue
        known_sensor = _known(recording, sensor)
        found = recheck(drive, asked, known_sensor, joint_covariance(sensor), options.solve, chance)
        course = Course(start_ns, drawn)
        sensors.append(_validated(drive, asked, sensor, found, course))
    tell("validating", 1.0)
    places = np.concatenate([_places(readings, each) for each in known])
    doubts, notes = _remarks(recording, field_map, calibration, map_source)
    return DriveValidation(
        sensors=tuple(sensors),
        missing=tuple(missing),
        drive=drive_metrics(recording),
        picture=map_picture(field_map, places),
        doubts=doubts,
        notes=notes,
    )


def is_sound(sensor: SensorCalibration) -> bool:
    """Return whether readings can be predicted and corrected with a calibration of a sensor."""
    C = sensor.distortion.C
    return bool(
        is_calibrated(sensor) and sensor.noise > 0 and np.linalg.cond(C) < 1e6
    )  # gains a million apart are no magnetometer's


def drive_of(readings: Readings, recording: Recording, sensor: SensorCalibration) -> SensorDrive:
    """Return what one sensor read, without what follows recorded numbers.

    Raises
    ------
    ConfigError
        Such a number was not recorded.
    """
    index = readings.sensors.index(sensor.sensor)
    own = readings[np.arange(len(readings))[readings.rows_of(index)]]
    own = replace(own, sensors=(sensor.sensor,), sensor=np.zeros(len(own), dtype=np.int64))
    names = [each.name for each in recording.scalars]
    if unknown := [each.name for each in sensor.moving if each.name not in names]:
        raise ConfigError(
            f"a part of the readings of {sensor.sensor} follows {unknown[0]!r}, which "
            "`bag.regressors` does not name; say in --config where it is recorded"
        )
    if own.regressors is not None and sensor.moving:
        h = _of_numbers(names, {each.name: each.h for each in sensor.moving})
        own = replace(own, field=without_moving(own.field, own.regressors, h))
    return SensorDrive(own, recording.trajectory)


def joint_covariance(sensor: SensorCalibration) -> FloatArray:
    """Return the covariance of (t, C row by row, H, time offset), shape (16, 16).

    The variance of a time offset that was held, or that the file does not speak of, is infinite:
    nothing is known of that clock.
    """
    joint = np.zeros((16, 16))
    joint[:15, :15] = sensor.covariance
    joint[15, 15] = np.inf
    offset = sensor.time_offset
    if offset is not None and offset.estimated:
        joint[15, :15] = joint[:15, 15] = offset.cross_covariance
        joint[15, 15] = offset.sigma**2
    return joint


@dataclass(frozen=True)
class Course:
    """How a drive is kept: since when, shape (1,), and in how many readings at most."""

    start_ns: IntArray
    most: int


def _known(recording: Recording, sensor: SensorCalibration) -> KnownCalibration:
    offset = np.array([_offset(sensor)])
    vector = [sensor.t_lidar_mag, sensor.distortion.vector(), offset]
    names = [each.name for each in recording.scalars]
    sigma = _of_numbers(names, {each.name: each.sigma for each in sensor.moving})
    return KnownCalibration(np.concatenate(vector), sensor.noise, sigma)


def _of_numbers(names: Sequence[str], values: dict[str, FloatArray]) -> FloatArray:
    """Return a vector for each number, zero where there is none, shape (K, 3)."""
    rows = [values.get(name, np.zeros(3)) for name in names]
    return np.reshape(np.array(rows, dtype=float), (-1, 3))


def _offset(sensor: SensorCalibration) -> float:
    return 0.0 if sensor.time_offset is None else sensor.time_offset.seconds


def _places(readings: Readings, sensor: SensorCalibration) -> FloatArray:
    own = readings.rows_of(readings.sensors.index(sensor.sensor))
    return np.asarray(readings.R_map_lidar[own] @ sensor.t_lidar_mag + readings.p_map_lidar[own])


def _why_silent(
    drive: SensorDrive,
    field_map: QueryableMap,
    sensor: SensorCalibration,
    options: CalibrationOptions,
    stuck: bool,
) -> str:
    """Return why nothing can be said of a sensor; nothing if something can."""
    readings, needed = drive.at(_offset(sensor)), options.solve.min_readings
    if stuck:
        return "It reports one constant value: it is stuck."
    if len(readings) < needed:
        return f"Only {len(readings)} of its readings have a pose; at least {needed} are needed."
    place = readings.R_map_lidar @ sensor.t_lidar_mag + readings.p_map_lidar
    within = int(field_map.query(place).inside.sum())
    if within < needed:
        return (
            f"{len(place) - within} of its {len(place)} readings lie outside the map; at least "
            f"{needed} must lie inside. Is it the map of this place, and are the poses in its "
            "frame?"
        )
    return ""


def _validated(
    drive: SensorDrive,
    field_map: QueryableMap,
    sensor: SensorCalibration,
    found: Recheck,
    course: Course,
) -> ValidatedSensor:
    """Return the figures of one sensor."""
    readings = drive.at(_offset(sensor))
    place = readings.R_map_lidar @ sensor.t_lidar_mag + readings.p_map_lidar
    within = field_map.query(place).inside
    evidence = sensor_evidence(
        DriveEvidence(readings, within, within & ~found.used), sensor, field_map
    )
    used, fields = evidence.used, curves(evidence, sensor)
    fit = fit_figures(evidence, sensor.noise)
    told, freedom = found.told, found.freedom
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
        nis=_of_readings(told.squared, freedom[0], sensor),
        parameters=_chi_square(told.explained(range(PARAMETERS)), freedom[1]),
        changes=_changes(found),
        noticeable=tuple(
            Noticeable(part, noticeable(told, part, NOTICED_SIGMAS)) for part in COLUMNS
        ),
        series=series(fields, evidence, course.start_ns, course.most),
    )


def _of_readings(value: float, freedom: int, sensor: SensorCalibration) -> ChiSquare:
    """Return the sum over readings; the noise that it counts in was itself estimated from others.

    Then it is Fisher's distribution that says what chance does, not chi-square's.
    """
    if sensor.residuals is None:
        return _chi_square(value, freedom)
    freedom, others = max(freedom, 1), max(3 * sensor.residuals.readings - PARAMETERS, 1)
    low, high = freedom * f.ppf(BAND, freedom, others)
    return ChiSquare(value, freedom, float(low), float(high))


def _chi_square(value: float, freedom: int) -> ChiSquare:
    low, high = chi2.ppf(BAND, max(freedom, 1))
    return ChiSquare(value, freedom, float(low), float(high))


def _changes(found: Recheck) -> tuple[Change, ...]:
    """Return the changes with what chance makes of each beside the others."""
    changes = []
    for part in found.parts:
        others = [each for each in found.parts if each is not part]
        gain = found.told.explained(columns_of(found.parts)) - found.told.explained(
            columns_of(others)
        )
        first = len(columns_of(found.parts[: found.parts.index(part)]))
        at = slice(first, first + width(part))
        sigma = np.sqrt(np.diag(found.covariance)[at])
        chance = float(chi2.sf(gain, width(part)))
        changes.append(change_of(part, found.change[at], sigma, chance))
    return tuple(changes)


def _missing(recording: Recording, calibration: CalibrationResult) -> list[NotValidated]:
    """Return sensors of the drive or the calibration that cannot be compared."""
    here, missing = [each.sensor for each in recording.series], []
    known = {each.sensor: each for each in calibration.sensors}
    for name in here:
        if name not in known:
            reason = "It is on the drive, but not in the calibration: nothing is known of it."
            missing.append(NotValidated(name, reason, faulty=False))
        elif not is_sound(known[name]):
            reason = f"The calibration does not know it: {known[name].message}."
            missing.append(NotValidated(name, reason, faulty=True))
    missing += [
        NotValidated(name, "It is in the calibration, but not on the drive.", faulty=False)
        for name in known
        if name not in here
    ]
    return missing


def _nothing_shared(
    recording: Recording, calibration: CalibrationResult, missing: Sequence[NotValidated]
) -> str:
    faulty = [each for each in missing if each.faulty]
    if faulty:
        return f"nothing to validate: {faulty[0].sensor}: {faulty[0].reason}"
    there = ", ".join(each.sensor for each in calibration.sensors) or "none"
    here = ", ".join(each.sensor for each in recording.series) or "none"
    return (
        f"{recording.source.path}: none of its sensors ({here}) is in the calibration ({there}); "
        "names come from topics or from `bag.fields` in --config"
    )


def _remarks(
    recording: Recording,
    field_map: QueryableMap,
    calibration: CalibrationResult,
    map_source: SourceFile | None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what speaks against the outcome, and what is worth knowing."""
    of_map = field_map.summary.doubts if isinstance(field_map, Summarised) else ()
    doubts, notes = [f"Of the map: {each}." for each in of_map], list[str]()
    if any(_same(drive, recording.source) for drive in calibration.drives):
        doubts.append(SAME_BAG)
    elif _same(calibration.map, map_source):
        notes.append(SAME_MAP)
    if not knows_its_errors(field_map):
        notes.append(NOT_CORRELATED)
    if calibration.uncertainty is Uncertainty.INDEPENDENT:
        notes.append(LOWER_BOUNDS)
    return tuple(doubts), tuple(notes)


def _same(one: SourceFile | None, other: SourceFile | None) -> bool:
    """Return whether both are there and have the same content."""
    return one is not None and other is not None and one.sha256 == other.sha256
