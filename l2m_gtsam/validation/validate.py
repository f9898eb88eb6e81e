"""Recording + map + calibration -> how far the calibration is still valid. Pure: no files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from l2m_gtsam.calibration.calibrate import prepare
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.offset_courses import ANYTHING_UT, Course, without_course
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import (
    FloatArray,
    Readings,
    Recording,
    SaturatedAxis,
    SourceFile,
    same_content,
)
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.maps.field_map import check_frame
from l2m_gtsam.maps.sources.changed_map import ChangedMap
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.qa.metrics.assemble import DRAWN, FEWEST, MOST, drive_metrics, map_picture
from l2m_gtsam.qa.metrics.changes import is_calibrated
from l2m_gtsam.recording.drive_trace import is_of
from l2m_gtsam.recording.saturation import saturation_sentence
from l2m_gtsam.recording.sync import stuck_sensors
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.error_budget import ErrorCause, OffsetDrift, OffsetJump
from l2m_gtsam.records.validation import (
    CalibrationPart,
    Displacement,
    DriveValidation,
    NotValidated,
    ValidatedSensor,
)
from l2m_gtsam.solve.correction import without_moving
from l2m_gtsam.validation.displacement import (
    DisplacementTest,
    ExplainedDrive,
    SensorsOnDrive,
    common_displacement,
)
from l2m_gtsam.validation.exchange import TestedSensor, exchanged
from l2m_gtsam.validation.figures import Thinning, doubts_and_notes, offset_s, sensor_figures
from l2m_gtsam.validation.innovation import KnownCalibration, estimate_of, together
from l2m_gtsam.validation.places import (
    AveragedBesideMap,
    PlaceOrVehicle,
    is_elsewhere,
    is_searched,
    spread,
    who_changed,
)
from l2m_gtsam.validation.recheck import SensorDrive, finite, inside, recheck, usable

OF_PLACE = {CalibrationPart.PLACE, CalibrationPart.ROTATION}  # that a displacement changes
NO_STEEL = "the readings show no steel that came or went"


@one_blas_thread()
def validate(
    recording: Recording,
    field_map: QueryableMap,
    calibration: CalibrationResult,
    options: CalibrationOptions,
    chance: float,
    map_source: SourceFile | None = None,
    progress: Progress = silent,
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
        Share of unchanged sensors in which a change may be found.
    map_source
        Where the map came from.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    CalibrationError
        Calibration and recording have no sensor in common, or it was computed from this drive.
    ConfigError
        Readings follow a number that was not recorded.
    MapError
        The poses are in another frame than the map.
    SyncError
        Readings and poses do not overlap.
    """
    check_frame(field_map, recording, map_source.path if map_source else "the map")
    if is_own_drive(recording, calibration):
        raise CalibrationError(
            f"{recording.source.path}: is the drive that the calibration was computed from, or a "
            "copy or a part of it: it agrees with itself; take another drive"
        )
    missing = missing_sensors(recording, calibration)
    here = {each.sensor for each in recording.series}
    known = [each for each in calibration.sensors if each.sensor in here and is_sound(each)]
    if not known:
        raise CalibrationError(nothing_shared(recording, calibration, missing))
    test = _test_of(recording, field_map, known, options, chance)
    surveyed, found = field_map, list[ValidatedSensor | NotValidated]()
    for index, sensor in enumerate(known):
        progress("validating", index / len(known))
        found.append(_tested(test, sensor))
    test, known, found = _as_exchanged(test, known, found)
    shift_test = _test_of_shifts(test, known, found)
    test, found, displacement = _beside_displacement(test, known, found, shift_test)
    test, found = _beside_courses(test, known, found)
    if displacement is None and test.courses:
        again = _test_of_shifts(test, known, found)
        test, found, displacement = _beside_displacement(test, known, found, again)
    judged, beside = _judged(test, known, found)
    if judged is not None and judged.best.of_place:
        field_map, found = ChangedMap(field_map, judged.found), beside
    progress("validating", 1.0)
    places = np.concatenate([_places(test.readings, each) for each in known])
    doubts, notes = doubts_and_notes(surveyed, calibration, map_source)
    if judged is not None:
        doubts = (judged.sentence, *doubts)
    elif is_searched(test.field_map, options.changes) and any(map(parts_of, found)):
        who = who_changed([each.sensor for each in known], [parts_of(each) for each in found])
        notes = (f"What changed is of {who}, not of the place: {NO_STEEL}.", *notes)
    return DriveValidation(
        sensors=tuple(_tests(found)),
        missing=(*missing, *(each for each in found if isinstance(each, NotValidated))),
        drive=drive_metrics(recording),
        picture=map_picture(field_map, places),
        doubts=doubts,
        notes=notes,
        sources=() if judged is None else judged.sources,
        explanations=() if judged is None else judged.explanations,
        displacement=displacement,
        detectable_shifts=() if shift_test is None else shift_test.detectable(chance),
        jumps=tuple(each for each in test.courses if isinstance(each, OffsetJump)),
        drifts=tuple(each for each in test.courses if isinstance(each, OffsetDrift)),
    )


@dataclass(frozen=True)
class _Test:
    """What all sensors are tested on.

    Attributes
    ----------
    recording, readings
        The drive, and what its sensors read with the poses.
    field_map
        The map, ready to be asked often.
    stuck
        Names of sensors that report one value.
    limits
        Of the range of each sensor, that readings exceed.
    options, chance
        As of `validate`.
    thinning
        How much of the drive is kept.
    courses
        Jumps and drifts of H that are taken off the readings.
    reads_as
        By the name of a sensor that of another, whose calibration its readings fit.
    """

    recording: Recording
    readings: Readings
    field_map: QueryableMap
    stuck: frozenset[str]
    limits: Mapping[str, tuple[SaturatedAxis, ...]]
    options: CalibrationOptions
    chance: float
    thinning: Thinning
    courses: tuple[Course, ...] = ()
    reads_as: Mapping[str, str] = field(default_factory=dict)

    def drive_of(self, sensor: SensorCalibration) -> SensorDrive:
        """Return what a sensor read, without what follows recorded numbers and courses of H."""
        found = drive_of(self.readings, self.recording, sensor)
        own = found.readings
        for course in self.courses_of(sensor):
            own = without_course(own, course)
        return replace(found, readings=own)

    def known(self, sensor: SensorCalibration) -> KnownCalibration:
        """Return its calibration; a course of H is a number whose field may be anything."""
        found, courses = _known(self.recording, sensor), len(self.courses_of(sensor))
        anything = np.full((courses, 3), ANYTHING_UT)
        return replace(found, number_sigma=np.concatenate([found.number_sigma, anything]))

    def courses_of(self, sensor: SensorCalibration) -> tuple[Course, ...]:
        """Return the jumps and drifts of a sensor."""
        return tuple(each for each in self.courses if each.sensor == sensor.sensor)

    def on_drive(self, known: Sequence[SensorCalibration]) -> SensorsOnDrive:
        """Return sensors with their calibrations."""
        return SensorsOnDrive(
            tuple(map(self.drive_of, known)),
            tuple(map(self.known, known)),
            tuple(finite(joint_covariance(each), self.options.solve) for each in known),
            tuple(map(alike_share, known)),
            self.field_map,
            self.options.solve,
        )


def _test_of(
    recording: Recording,
    field_map: QueryableMap,
    known: Sequence[SensorCalibration],
    options: CalibrationOptions,
    chance: float,
) -> _Test:
    """Return what sensors that are known are tested on; others take no part."""
    shared = {each.sensor for each in known}
    kept = tuple(each for each in recording.series if each.sensor in shared)
    synchronised = prepare(replace(recording, series=kept), options)
    readings = synchronised.readings
    pairs = zip(readings.sensors, synchronised.counts, strict=True)
    return _Test(
        recording=recording,
        readings=readings,
        field_map=for_solvers(field_map),
        stuck=frozenset(readings.sensors[k] for k in stuck_sensors(readings)),
        limits={name: counts.limits for name, counts in pairs},
        options=options,
        chance=chance,
        thinning=Thinning(
            readings.stamp_ns.min(keepdims=True), int(np.clip(DRAWN // len(known), FEWEST, MOST))
        ),
    )


def _as_exchanged(
    test: _Test,
    known: list[SensorCalibration],
    found: list[ValidatedSensor | NotValidated],
) -> tuple[_Test, list[SensorCalibration], list[ValidatedSensor | NotValidated]]:
    """Return the calibrations that readings are of, and what is found with them."""
    tested = [
        TestedSensor(test.drive_of(one), test.known(one), each)
        for one, each in zip(known, found, strict=True)
        if isinstance(each, ValidatedSensor)
    ]
    theirs = exchanged(tested, test.field_map)
    if not theirs:
        return test, known, found
    of = {each.sensor: each for each in known}
    test = replace(test, reads_as=theirs)
    known = [replace(of[theirs.get(name, name)], sensor=name) for name in of]
    return test, known, [_tested(test, each) for each in known]


def _test_of_shifts(
    test: _Test,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> DisplacementTest | None:
    """Return the test of displacements of all sensors together; none where there are none.

    What has changed of sensors and cannot be of a displacement is free in it.
    """
    kept = _kept(known, found)
    if not kept:
        return None
    sensors, parts = test.on_drive(kept), [parts_of(each) for each in _tests(found)]
    free = (
        P + spread(one.distortion.C, tuple(part for part in own if part not in OF_PLACE))
        for P, one, own in zip(sensors.spreads, kept, parts, strict=True)
    )
    return DisplacementTest.of(replace(sensors, spreads=tuple(free)))


def _beside_displacement(
    test: _Test,
    known: Sequence[SensorCalibration],
    found: list[ValidatedSensor | NotValidated],
    shift_test: DisplacementTest | None,
) -> tuple[_Test, list[ValidatedSensor | NotValidated], Displacement | None]:
    """Return the displacement that sensors share, if they do, and what is found beside it."""
    if shift_test is None:
        return test, found, None
    sensors = test.on_drive(_kept(known, found))
    shared = common_displacement(
        sensors, shift_test, test.chance, lambda: _others(test, known, found)
    )
    if shared is None:
        return test, found, None
    by, record = shared
    poses = by.applied(test.recording.trajectory)
    displaced = replace(test, recording=replace(test.recording, trajectory=poses))
    beside = [_tested(displaced, each) for each in known]
    return (test, found, None) if is_elsewhere(found, beside) else (displaced, beside, record)


def _others(
    test: _Test,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> list[ExplainedDrive]:
    """Return what explains readings beside a displacement: courses of H, and steel."""
    kept, averages = _kept(known, found), _averaged(test, known, found)
    if averages is None:
        return []
    others = []
    if averages.courses:
        sensors = replace(test, courses=(*test.courses, *averages.courses)).on_drive(kept)
        others.append(ExplainedDrive.by(sensors, averages.found_courses.parameters, test.chance))
    if (shown := averages.shown) is not None:
        changed = replace(test, field_map=ChangedMap(test.field_map, shown.found))
        others.append(
            ExplainedDrive.by(changed.on_drive(kept), shown.found.parameters, test.chance)
        )
    return others


def _tests(found: Sequence[ValidatedSensor | NotValidated]) -> list[ValidatedSensor]:
    """Return what was found of sensors that could be tested."""
    return [each for each in found if isinstance(each, ValidatedSensor)]


def _kept(
    known: Sequence[SensorCalibration], found: Sequence[ValidatedSensor | NotValidated]
) -> list[SensorCalibration]:
    """Return the sensors that could be tested."""
    pairs = zip(known, found, strict=True)
    return [one for one, each in pairs if isinstance(each, ValidatedSensor)]


def _averaged(
    test: _Test,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> AveragedBesideMap | None:
    """Return the averaged drive if places are suspected on it, or sensors changed."""
    kept = _kept(known, found)
    if not kept:
        return None
    readings, estimate = _of_all(test, kept)
    averages = AveragedBesideMap.of(readings, test.field_map, estimate, test.options.changes)
    return averages if len(averages.places) or any(map(parts_of, found)) else None


def _beside_courses(
    test: _Test,
    known: Sequence[SensorCalibration],
    found: list[ValidatedSensor | NotValidated],
) -> tuple[_Test, list[ValidatedSensor | NotValidated]]:
    """Return the test without jumps and drifts of H, and what is found then."""
    averages = _averaged(test, known, found)
    if averages is None or not averages.courses:
        return test, found
    without = replace(test, courses=averages.courses)
    beside = [_tested(without, each) for each in known]
    return (test, found) if is_elsewhere(found, beside) else (without, beside)


def _judged(
    test: _Test,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> tuple[PlaceOrVehicle | None, list[ValidatedSensor | NotValidated]]:
    """Return whether the place changed or the vehicle, and what is found if the place did."""
    kept = _kept(known, found)
    averages = _averaged(test, known, found)
    if averages is None or (shown := averages.shown) is None:
        return None, []
    changed = replace(test, field_map=ChangedMap(test.field_map, shown.found))
    beside = [_tested(changed, sensor) for sensor in known]
    if is_elsewhere(found, beside):
        return None, []
    covariances = np.array([finite(joint_covariance(each), test.options.solve) for each in kept])
    alone, besides = (
        [parts_of(each) for one, each in zip(known, which, strict=True) if one in kept]
        for which in (found, beside)
    )
    return shown.judged(covariances, alone, besides), beside


def parts_of(found: ValidatedSensor | NotValidated) -> tuple[CalibrationPart, ...]:
    """Return the parts of a sensor that have changed."""
    return tuple(e.part for e in found.changes) if isinstance(found, ValidatedSensor) else ()


def _of_all(test: _Test, known: Sequence[SensorCalibration]) -> tuple[Readings, Estimate]:
    """Return the readings of sensors inside the map, and their calibrations.

    Where steel is not looked for, without those that it may explain: it would look like jumps.
    """
    drives = [test.drive_of(each) for each in known]
    calibrations = [test.known(each) for each in known]
    searched = is_searched(test.field_map, test.options.changes)
    counts = [
        inside(drive, test.field_map, each)
        if searched
        else usable(drive, test.field_map, each, test.options.solve)
        for drive, each in zip(drives, calibrations, strict=True)
    ]
    vectors = np.array([each.vector for each in calibrations])
    estimate = estimate_of(vectors, np.array([each.noise for each in calibrations]))
    readings = together(
        [drive.at(offset_s(each)) for drive, each in zip(drives, known, strict=True)]
    )
    return readings.select(np.concatenate(counts)), estimate


def _tested(test: _Test, sensor: SensorCalibration) -> ValidatedSensor | NotValidated:
    """Return one sensor tested on the drive, or why it cannot be."""
    drive, options = test.drive_of(sensor), test.options
    limits = test.limits[sensor.sensor]
    if reason := _why_untested(drive, test.field_map, sensor, options, sensor.sensor in test.stuck):
        beyond = f"{saturation_sentence(limits)}. " if limits else ""
        return NotValidated(sensor.sensor, f"{beyond}{reason}", faulty=True)
    known, covariance = test.known(sensor), joint_covariance(sensor)
    found = recheck(drive, test.field_map, known, covariance, options.solve, test.chance)
    figures = sensor_figures(drive, test.field_map, sensor, found, test.thinning, test.chance)
    return replace(figures, limits=limits, reads_as=test.reads_as.get(sensor.sensor, ""))


def drive_of(readings: Readings, recording: Recording, sensor: SensorCalibration) -> SensorDrive:
    """Return what one sensor read, without what follows recorded numbers.

    Raises
    ------
    ConfigError
        Such a number was not recorded.
    """
    own = readings.alone(readings.sensors.index(sensor.sensor))
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

    The variance of a time offset that was held, or that the file does not have, is infinite:
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


def alike_share(sensor: SensorCalibration) -> float:
    """Return the share of the variances of a calibration that others may have in common with it.

    All but the noise of the readings; all, where the file does not tell.
    """
    own = [each for each in sensor.variance_shares if each.cause is ErrorCause.NOISE]
    return 1 - min((share for each in own for share in (each.t, each.C, each.H)), default=0.0)


def _known(recording: Recording, sensor: SensorCalibration) -> KnownCalibration:
    vector = np.append(sensor.vector(), offset_s(sensor))
    names = [each.name for each in recording.scalars]
    sigma = _of_numbers(names, {each.name: each.sigma for each in sensor.moving})
    return KnownCalibration(vector, sensor.noise, sigma)


def _of_numbers(names: Sequence[str], values: dict[str, FloatArray]) -> FloatArray:
    """Return a vector for each number, zero where there is none, shape (K, 3)."""
    rows = [values.get(name, np.zeros(3)) for name in names]
    return np.reshape(np.array(rows, dtype=float), (-1, 3))


def _places(readings: Readings, sensor: SensorCalibration) -> FloatArray:
    own = readings.rows_of(readings.sensors.index(sensor.sensor))
    return np.asarray(readings.R_map_lidar[own] @ sensor.t_lidar_mag + readings.p_map_lidar[own])


def _why_untested(
    drive: SensorDrive,
    field_map: QueryableMap,
    sensor: SensorCalibration,
    options: CalibrationOptions,
    stuck: bool,
) -> str:
    """Return why a sensor cannot be tested; empty if it can."""
    readings, needed = drive.at(offset_s(sensor)), options.solve.min_readings
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


def is_sound(sensor: SensorCalibration) -> bool:
    """Return whether readings can be predicted and corrected with a calibration of a sensor."""
    C = sensor.distortion.C
    return bool(
        is_calibrated(sensor) and sensor.noise > 0 and np.linalg.cond(C) < 1e6
    )  # gains a million apart are no magnetometer's


def missing_sensors(recording: Recording, calibration: CalibrationResult) -> list[NotValidated]:
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


def nothing_shared(
    recording: Recording, calibration: CalibrationResult, missing: Sequence[NotValidated]
) -> str:
    """Return why no sensor can be compared, with what to do about it."""
    faulty = [each for each in missing if each.faulty]
    if faulty:
        return f"nothing to validate: {faulty[0].sensor}: {faulty[0].reason}"
    there = ", ".join(each.sensor for each in calibration.sensors) or "none"
    here = ", ".join(each.sensor for each in recording.series) or "none"
    return (
        f"{recording.source.path}: none of its sensors ({here}) is in the calibration ({there}); "
        "names come from topics or from `bag.fields` in --config"
    )


def is_own_drive(recording: Recording, calibration: CalibrationResult) -> bool:
    """Return whether a calibration was computed from a drive, whatever file that is in."""
    poses = recording.trajectory
    return any(same_content(drive, recording.source) for drive in calibration.drives) or any(
        is_of(trace, poses.stamp_ns, poses.p) for trace in calibration.traces
    )
