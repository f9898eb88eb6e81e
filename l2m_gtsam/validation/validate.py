"""Recording + map + calibration -> how far the calibration is still valid. Pure: no files."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings, Recording, SourceFile, same_content
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
)
from l2m_gtsam.validation.displacement import (
    DisplacementTest,
    ExplainedDrive,
    common_displacement,
)
from l2m_gtsam.validation.drive_test import drive_test, joint_covariance
from l2m_gtsam.validation.exchange import TestedSensor, exchanged
from l2m_gtsam.validation.figures import doubts_and_notes
from l2m_gtsam.validation.places import (
    PlaceOrVehicle,
    is_elsewhere,
    is_searched,
    spread,
    who_changed,
)
from l2m_gtsam.validation.recheck import finite
from l2m_gtsam.validation.tested_drive import TestedDrive, parts_of

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
    drive = _as_exchanged(TestedDrive.of(test, known, progress))
    shift_test = _test_of_shifts(drive)
    drive, displacement = _beside_displacement(drive, shift_test)
    drive = _beside_courses(drive)
    if displacement is None and drive.test.courses:
        drive, displacement = _beside_displacement(drive, _test_of_shifts(drive))
    drive, judged = _beside_steel(drive)
    progress("validating", 1.0)
    doubts, notes = doubts_and_notes(field_map, calibration, map_source)
    if test.extent.left_out:
        notes = (*notes, f"{test.extent.note[:1].upper()}{test.extent.note[1:]}.")
    if judged is not None:
        doubts = (judged.sentence, *doubts)
    elif is_searched(drive.test.field_map, options.changes) and drive.changed:
        who = who_changed([each.sensor for each in drive.known], drive.parts)
        notes = (f"What changed is of {who}, not of the place: {NO_STEEL}.", *notes)
    shown = field_map
    if judged is not None and judged.best.of_place:
        shown = ChangedMap(field_map, judged.found)
    places = np.concatenate([_places(drive.test.readings, each) for each in drive.known])
    courses = drive.test.courses
    return DriveValidation(
        sensors=tuple(drive.sensors),
        missing=(*missing, *drive.untested),
        drive=drive_metrics(recording),
        picture=map_picture(shown, places),
        doubts=doubts,
        notes=notes,
        sources=() if judged is None else judged.sources,
        explanations=() if judged is None else judged.explanations,
        displacement=displacement,
        detectable_shifts=() if shift_test is None else shift_test.detectable(chance),
        jumps=tuple(each for each in courses if isinstance(each, OffsetJump)),
        drifts=tuple(each for each in courses if isinstance(each, OffsetDrift)),
    )


def _as_exchanged(drive: TestedDrive) -> TestedDrive:
    """Return a drive with the calibrations that readings are of."""
    test = drive.test
    pairs = zip(map(test.drive_of, drive.calibrations), drive.sensors, strict=True)
    theirs = exchanged([TestedSensor(*each) for each in pairs])
    if not theirs:
        return drive
    of = {each.sensor: each for each in drive.known}
    known = [replace(of[theirs.get(name, name)], sensor=name) for name in of]
    return TestedDrive.of(replace(test, reads_as=theirs), known)


def _test_of_shifts(drive: TestedDrive) -> DisplacementTest | None:
    """Return the test of displacements of all sensors together; none where there are none.

    What has changed of sensors and cannot be of a displacement is free in it.
    """
    if not drive.sensors:
        return None
    sensors = drive.test.on_drive(drive.calibrations)
    free = (
        P + spread(one.distortion.C, tuple(part for part in parts_of(each) if part not in OF_PLACE))
        for P, one, each in zip(sensors.spreads, drive.calibrations, drive.sensors, strict=True)
    )
    return DisplacementTest.of(replace(sensors, spreads=tuple(free)))


def _beside_displacement(
    drive: TestedDrive, shift_test: DisplacementTest | None
) -> tuple[TestedDrive, Displacement | None]:
    """Return the displacement that sensors share, if they do, and the drive beside it."""
    if shift_test is None:
        return drive, None
    test = drive.test
    sensors = test.on_drive(drive.calibrations)
    shared = common_displacement(sensors, shift_test, test.chance, lambda: _others(drive))
    if shared is None:
        return drive, None
    by, record = shared
    poses = by.applied(test.recording.trajectory)
    displaced = replace(test, recording=replace(test.recording, trajectory=poses))
    beside = drive.beside(displaced)
    return (drive, None) if is_elsewhere(drive.found, beside.found) else (beside, record)


def _others(drive: TestedDrive) -> list[ExplainedDrive]:
    """Return what explains readings beside a displacement: courses of H, and steel."""
    test, averages = drive.test, drive.averages
    if averages is None:
        return []
    explained = []
    if averages.courses:
        courses = replace(test, courses=(*test.courses, *averages.courses))
        explained.append((courses, averages.found_courses.parameters))
    if (shown := averages.shown) is not None:
        steel = replace(test, field_map=ChangedMap(test.field_map, shown.found))
        explained.append((steel, shown.found.parameters))
    return [
        ExplainedDrive.by(beside.on_drive(drive.calibrations), parameters, test.chance)
        for beside, parameters in explained
    ]


def _beside_courses(drive: TestedDrive) -> TestedDrive:
    """Return a drive without jumps and drifts of H."""
    if drive.averages is None or not drive.averages.courses:
        return drive
    beside = drive.beside(replace(drive.test, courses=drive.averages.courses))
    return drive if is_elsewhere(drive.found, beside.found) else beside


def _beside_steel(drive: TestedDrive) -> tuple[TestedDrive, PlaceOrVehicle | None]:
    """Return whether the place changed or the vehicle, and the drive beside steel if it did."""
    test = drive.test
    if drive.averages is None or (shown := drive.averages.shown) is None:
        return drive, None
    beside = drive.beside(replace(test, field_map=ChangedMap(test.field_map, shown.found)))
    if is_elsewhere(drive.found, beside.found):
        return drive, None
    covariances = [finite(joint_covariance(e), test.options.solve) for e in drive.calibrations]
    alone, besides = (list(compress(each.parts, drive.is_tested)) for each in (drive, beside))
    judged = shown.judged(np.array(covariances), alone, besides)
    return beside if judged.best.of_place else drive, judged


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
