"""Recording + map + calibration -> how far the calibration is still valid. Pure: no files."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import (
    FloatArray,
    Readings,
    Recording,
    SourceFile,
    same_content,
)
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.maps.field_map import check_frame
from l2m_gtsam.maps.sources.changed_map import ChangedMap
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.qa.metrics.assemble import drive_metrics, map_picture
from l2m_gtsam.qa.metrics.changes import is_calibrated
from l2m_gtsam.recording.drive_trace import is_of
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.error_budget import OffsetDrift, OffsetJump
from l2m_gtsam.records.validation import (
    CalibrationPart,
    Displacement,
    DriveValidation,
    NotValidated,
    ValidatedSensor,
)
from l2m_gtsam.validation.displacement import (
    DisplacementTest,
    ExplainedDrive,
    common_displacement,
)
from l2m_gtsam.validation.drive_test import (
    DriveTest,
    drive_test,
    joint_covariance,
    parts_of,
    testable,
    tested,
    tests_in,
)
from l2m_gtsam.validation.exchange import TestedSensor, exchanged
from l2m_gtsam.validation.figures import doubts_and_notes, offset_s
from l2m_gtsam.validation.innovation import estimate_of, together
from l2m_gtsam.validation.places import (
    AveragedBesideMap,
    PlaceOrVehicle,
    is_elsewhere,
    is_searched,
    spread,
    who_changed,
)
from l2m_gtsam.validation.recheck import finite, inside, usable

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
    test = drive_test(recording, field_map, known, options, chance)
    surveyed, found = field_map, list[ValidatedSensor | NotValidated]()
    for index, sensor in enumerate(known):
        progress("validating", index / len(known))
        found.append(tested(test, sensor))
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
        sensors=tuple(tests_in(found)),
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


def _as_exchanged(
    test: DriveTest,
    known: list[SensorCalibration],
    found: list[ValidatedSensor | NotValidated],
) -> tuple[DriveTest, list[SensorCalibration], list[ValidatedSensor | NotValidated]]:
    """Return the calibrations that readings are of, and what is found with them."""
    on_drive = [
        TestedSensor(test.drive_of(one), test.known(one), each)
        for one, each in zip(known, found, strict=True)
        if isinstance(each, ValidatedSensor)
    ]
    theirs = exchanged(on_drive, test.field_map)
    if not theirs:
        return test, known, found
    of = {each.sensor: each for each in known}
    test = replace(test, reads_as=theirs)
    known = [replace(of[theirs.get(name, name)], sensor=name) for name in of]
    return test, known, [tested(test, each) for each in known]


def _test_of_shifts(
    test: DriveTest,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> DisplacementTest | None:
    """Return the test of displacements of all sensors together; none where there are none.

    What has changed of sensors and cannot be of a displacement is free in it.
    """
    kept = testable(known, found)
    if not kept:
        return None
    sensors, parts = test.on_drive(kept), [parts_of(each) for each in tests_in(found)]
    free = (
        P + spread(one.distortion.C, tuple(part for part in own if part not in OF_PLACE))
        for P, one, own in zip(sensors.spreads, kept, parts, strict=True)
    )
    return DisplacementTest.of(replace(sensors, spreads=tuple(free)))


def _beside_displacement(
    test: DriveTest,
    known: Sequence[SensorCalibration],
    found: list[ValidatedSensor | NotValidated],
    shift_test: DisplacementTest | None,
) -> tuple[DriveTest, list[ValidatedSensor | NotValidated], Displacement | None]:
    """Return the displacement that sensors share, if they do, and what is found beside it."""
    if shift_test is None:
        return test, found, None
    sensors = test.on_drive(testable(known, found))
    shared = common_displacement(
        sensors, shift_test, test.chance, lambda: _others(test, known, found)
    )
    if shared is None:
        return test, found, None
    by, record = shared
    poses = by.applied(test.recording.trajectory)
    displaced = replace(test, recording=replace(test.recording, trajectory=poses))
    beside = [tested(displaced, each) for each in known]
    return (test, found, None) if is_elsewhere(found, beside) else (displaced, beside, record)


def _others(
    test: DriveTest,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> list[ExplainedDrive]:
    """Return what explains readings beside a displacement: courses of H, and steel."""
    kept, averages = testable(known, found), _averaged(test, known, found)
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


def _averaged(
    test: DriveTest,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> AveragedBesideMap | None:
    """Return the averaged drive if places are suspected on it, or sensors changed."""
    kept = testable(known, found)
    if not kept:
        return None
    readings, estimate = _of_all(test, kept)
    averages = AveragedBesideMap.of(readings, test.field_map, estimate, test.options.changes)
    return averages if len(averages.places) or any(map(parts_of, found)) else None


def _beside_courses(
    test: DriveTest,
    known: Sequence[SensorCalibration],
    found: list[ValidatedSensor | NotValidated],
) -> tuple[DriveTest, list[ValidatedSensor | NotValidated]]:
    """Return the test without jumps and drifts of H, and what is found then."""
    averages = _averaged(test, known, found)
    if averages is None or not averages.courses:
        return test, found
    without = replace(test, courses=averages.courses)
    beside = [tested(without, each) for each in known]
    return (test, found) if is_elsewhere(found, beside) else (without, beside)


def _judged(
    test: DriveTest,
    known: Sequence[SensorCalibration],
    found: Sequence[ValidatedSensor | NotValidated],
) -> tuple[PlaceOrVehicle | None, list[ValidatedSensor | NotValidated]]:
    """Return whether the place changed or the vehicle, and what is found if the place did."""
    kept = testable(known, found)
    averages = _averaged(test, known, found)
    if averages is None or (shown := averages.shown) is None:
        return None, []
    changed = replace(test, field_map=ChangedMap(test.field_map, shown.found))
    beside = [tested(changed, sensor) for sensor in known]
    if is_elsewhere(found, beside):
        return None, []
    covariances = np.array([finite(joint_covariance(each), test.options.solve) for each in kept])
    alone, besides = (
        [parts_of(each) for one, each in zip(known, which, strict=True) if one in kept]
        for which in (found, beside)
    )
    return shown.judged(covariances, alone, besides), beside


def _of_all(test: DriveTest, known: Sequence[SensorCalibration]) -> tuple[Readings, Estimate]:
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


def _places(readings: Readings, sensor: SensorCalibration) -> FloatArray:
    own = readings.rows_of(readings.sensors.index(sensor.sensor))
    return np.asarray(readings.R_map_lidar[own] @ sensor.t_lidar_mag + readings.p_map_lidar[own])


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
