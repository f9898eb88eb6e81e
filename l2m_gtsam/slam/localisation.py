"""Localise a recording in a map with calibrated sensors. Pure: no files, no terminal."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import FloatArray, Readings, Recording, RigidTransform, Trajectory
from l2m_gtsam.errors import CalibrationError, ConfigError, L2MError, SyncError
from l2m_gtsam.geometry import isotropic_covariance
from l2m_gtsam.maps.field_map import check_frame
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.recording.dropouts import is_dead, mask_dropouts
from l2m_gtsam.recording.odometry_jumps import RepairedOdometry, without_jumps
from l2m_gtsam.recording.sync import SyncOptions, synchronise, with_offsets
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.records.scans import ScanEvidence
from l2m_gtsam.slam.drift import plane_hints
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose, odometry_jumps
from l2m_gtsam.slam.held_calibration import held_notes, with_calibration_use
from l2m_gtsam.slam.key_pose_readings import Fewer, key_pose_readings, thinned_readings
from l2m_gtsam.slam.links import key_pose_links, link_stamps
from l2m_gtsam.slam.misfit import decoy_maps, needs_misfit_test
from l2m_gtsam.slam.moved_sensors import calibration_changes, sensor_to_leave_out, without_series
from l2m_gtsam.slam.moving_fields import without_moving_fields
from l2m_gtsam.slam.odometry import key_pose_rows, odometry_steps, with_rows_at
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, StartPoseOptions, StepAxes
from l2m_gtsam.slam.pose_graph import solve_pose_graph
from l2m_gtsam.slam.result import localisation_result
from l2m_gtsam.slam.slips import judged, with_open_jumps
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.start.search import find_start, start_found
from l2m_gtsam.solve.noise import NOISE_RANGE

NO_SCANS = ScanEvidence()
DEAD = "it has no readings, or repeats one value"


@dataclass(frozen=True)
class Localisation:
    """A localisation and the solution behind it.

    Attributes
    ----------
    result
        Poses, verdict and figures; the files of map and calibration are to be filled in.
    solution
        Solution of the graph.
    """

    result: LocalisationResult
    solution: DriveSolution


@one_blas_thread()
def localise(
    recording: Recording,
    field_map: QueryableMap,
    calibration: CalibrationResult,
    options: SlamOptions,
    progress: Progress,
    evidence: ScanEvidence = NO_SCANS,
) -> Localisation:
    """Estimate the poses of a drive in a magnetic map.

    Parameters
    ----------
    recording
        A drive; its poses are odometry, whose first is in the map unless the options give another.
    field_map
        Map that is queried for field, gradient and variance.
    calibration
        Of the sensors.
    options
        Key poses, odometry, start, and whether the calibration is refined.
    progress
        Called with a stage and the fraction of it that is done.
    evidence
        Registrations of the drive's scans.

    Raises
    ------
    CalibrationError
        No sensor of the recording is calibrated.
    SyncError
        Readings and poses do not overlap, or there are fewer than two poses.
    MapError
        The start was searched for, and several places of the map fit or none. Or it is that of
        odometry, which is in another frame than the map.
    ConfigError
        Odometry is to know its steps along fixed axes, in a map.
    """
    if options.drift.axes is StepAxes.FIXED:
        raise ConfigError(
            "`slam.drift.axes: fixed` works without a map: leave out --map, or give `vehicle`"
        )
    if options.start.by_odometry:
        check_frame(field_map, recording)
    found = localised(recording, field_map, calibration, options, progress, evidence)
    tried: dict[str, Localisation] = {}

    def without(sensor: str) -> dict[str, float]:
        rest = without_series(recording, [sensor])
        try:
            tried[sensor] = localised(rest, field_map, calibration, options, progress, evidence)
        except (L2MError, np.linalg.LinAlgError):  # the others do not place the vehicle
            return {}
        return calibration_changes(calibration, tried[sensor].result)

    out = sensor_to_leave_out(calibration_changes(calibration, found.result), without)
    if out is None:
        return found
    better = tried[out.sensor]
    notes = (*better.result.notes, out.note())
    return replace(better, result=replace(better.result, notes=notes))


def localised(
    recording: Recording,
    field_map: QueryableMap,
    calibration: CalibrationResult,
    options: SlamOptions,
    progress: Progress,
    evidence: ScanEvidence,
) -> Localisation:
    """Return the same with all sensors that are calibrated, whether or not they hold."""
    drive, notes = prepared(recording, calibration, options, evidence)
    options = with_calibration_use(options, drive.sensors, one_field=False)
    solver_map = for_solvers(field_map)
    search = None
    if options.start.anywhere:
        search = find_start(drive, solver_map, options, progress)
        drive = replace(drive, start=start_found(search, options.start))
    by_scans = solve_pose_graph(
        with_open_jumps(drive.as_walk(options.drift.over_m)), options.robust.confidence
    )
    drive = replace(drive, links=drive.links[by_scans.believed])
    odometry = judged(drive, lambda each: localise_drive(each, solver_map, options, progress))
    drive = odometry.drive
    solution = localise_drive(drive, solver_map, options, progress)
    maps = decoy_maps(drive, solver_map) if needs_misfit_test(solution) else ()
    decoys = [found for each in maps if (found := in_decoy(drive, each, options)) is not None]
    refined = options.calibration is CalibrationUse.REFINED
    kept = calibration if refined else None
    result = localisation_result(drive, solution, by_scans, kept, decoys)
    held = () if refined else held_notes(drive)
    notes = (*notes, *held, *odometry.notes, *result.notes, *decoy_notes(len(maps), len(decoys)))
    level = plane_hints(recording.trajectory, options.drift, is_stated=drive.steps.stated)
    hints = (*level, *result.hints)
    result = replace(result, notes=notes, hints=hints, bag=recording.source, start=search)
    return Localisation(result, solution)


def in_decoy(drive: Drive, decoy: QueryableMap, options: SlamOptions) -> DriveSolution | None:
    """Return a drive's solution in a decoy map; None where it has none, which says nothing."""
    try:
        return localise_drive(drive, decoy, options, silent)
    except (CalibrationError, np.linalg.LinAlgError):  # in a wrong field poses may go anywhere
        return None


def decoy_notes(made: int, solved: int) -> tuple[str, ...]:
    """Return what is left open where a drive has no solution in some of the decoy maps."""
    if solved == made:
        return ()
    note = (
        f"the test against a map of another place is weaker than usual: the drive has a solution "
        f"in {solved} of {made} decoys only (this map, turned by 180 degrees)"
    )
    return (note,)


def prepared(
    recording: Recording,
    calibration: CalibrationResult,
    options: SlamOptions,
    evidence: ScanEvidence = NO_SCANS,
    fewer: Fewer = thinned_readings,
) -> tuple[Drive, tuple[str, ...]]:
    """Return a recording as a drive of its calibrated sensors, and warnings.

    Parameters
    ----------
    recording, calibration, options, evidence
        As of ``localise``.
    fewer
        Makes at most ``key_poses.readings`` of a sensor's readings on a key pose.

    Raises
    ------
    CalibrationError
        No sensor of the recording is calibrated.
    SyncError
        Readings and poses do not overlap, there are fewer than two poses, or all sensors are dead.
    """
    if len(recording.trajectory) < 2:
        raise SyncError(f"{recording.source.path}: odometry of one pose; two or more are needed")
    repaired = RepairedOdometry(recording.trajectory, (), 0)
    if options.drift.axes is StepAxes.VEHICLE:  # a repair turns all that follows
        repaired = without_jumps(recording.trajectory, options.jumps)
    odometry = repaired.trajectory
    masked = mask_dropouts(replace(recording, trajectory=odometry))
    still = without_moving_fields(masked.recording, calibration, options.regressors)
    calibrated, left_out = usable_sensors(still.recording, still.calibration)
    readings = drive_readings(still.recording, calibrated, options)
    rows = np.union1d(key_pose_rows(odometry, options.key_poses), repaired.rows)
    if len(evidence):
        rows = with_rows_at(rows, odometry, link_stamps(evidence))
    readings = fewer(readings, odometry, rows, options.key_poses.readings)
    drive = Drive(
        stamp_ns=odometry.stamp_ns[rows],
        steps=odometry_steps(odometry, rows, options.drift, repaired.jumps),
        readings=key_pose_readings(readings, odometry, rows),
        start=start_pose(odometry, options.start),
        sensors=known_sensors(calibrated),
        reading_ns=readings.stamp_ns,
        links=key_pose_links(evidence, odometry, rows, options.drift),
        jumps=odometry_jumps(repaired, rows, options.drift),
    )
    recorded = (note for part in recording.parts for note in part.notes)
    return drive, (*recorded, *repaired.notes(), *left_out, *masked.notes)


def usable_sensors(
    recording: Recording, calibration: CalibrationResult
) -> tuple[tuple[SensorCalibration, ...], tuple[str, ...]]:
    """Return the calibrated sensors of a recording, and a note on each of the others.

    Raises
    ------
    CalibrationError
        There is none.
    SyncError
        Those that are have no readings.
    """
    entries = {each.sensor: each for each in calibration.sensors}
    usable, notes, dead = [], list[str](), list[str]()
    for series in recording.series:
        entry = entries.get(series.sensor)
        if entry is None or why_unusable(entry):
            notes.append(left_out(series.sensor, why_unusable(entry)))
        elif is_dead(series):
            dead.append(series.sensor)
        else:
            usable.append(entry)
    notes += [left_out(each, DEAD) for each in dead]
    if dead and not usable:
        raise SyncError(f"{recording.source.path}: {', '.join(dead)}: {DEAD}")
    if not usable:
        sensors = ", ".join(series.sensor for series in recording.series)
        raise CalibrationError(
            f"{recording.source.path}: none of its sensors ({sensors}) is calibrated; the "
            f"calibration has {', '.join(entries) or 'no sensor'}"
        )
    return tuple(usable), tuple(notes)


def left_out(sensor: str, reason: str) -> str:
    """Return that a sensor is left out and why, a sentence."""
    return f"{sensor} is left out: {reason}"


def why_unusable(entry: SensorCalibration | None) -> str:
    """Return why a sensor's readings cannot be used, a clause; nothing if they can."""
    if entry is None:
        return "it has no calibration"
    if not is_determined(entry):
        return f"its calibration is {entry.status.value}"
    numbers = ", ".join(each.name for each in entry.moving)
    if not numbers:
        return ""
    return f"a part of its readings follows {numbers}, which is not known (`bag.regressors`)"


def is_determined(sensor: SensorCalibration) -> bool:
    """Return whether all 15 parameters of a sensor, their covariance and its noise are finite."""
    values = np.append(sensor.distortion.vector(), [*sensor.t_lidar_mag, sensor.noise])
    return bool(np.isfinite(values).all() and np.isfinite(sensor.covariance).all())


def known_sensors(calibrated: tuple[SensorCalibration, ...]) -> KnownSensors:
    """Return calibrations as arrays."""
    return KnownSensors(
        names=tuple(each.sensor for each in calibrated),
        t=np.stack([each.t_lidar_mag for each in calibrated]),
        distortion=np.stack([each.distortion.vector() for each in calibrated]),
        offset=clock_offsets(calibrated),
        noise=np.maximum([each.noise for each in calibrated], NOISE_RANGE[0]),
        covariance=np.stack([each.covariance for each in calibrated]),
    )


def clock_offsets(calibrated: tuple[SensorCalibration, ...]) -> FloatArray:
    """Return the sensors' clock offsets in seconds, shape (S,)."""
    offsets = [each.time_offset for each in calibrated]
    return np.array([0.0 if each is None else each.seconds for each in offsets])


def drive_readings(
    recording: Recording, calibrated: tuple[SensorCalibration, ...], options: SlamOptions
) -> Readings:
    """Return the readings of calibrated sensors with poses of odometry.

    All are kept: readings of a revisited place, which a calibration thins, close loops here.
    """
    names, offset = [each.sensor for each in calibrated], clock_offsets(calibrated)
    chosen = tuple(each for each in recording.series if each.sensor in names)
    sync = SyncOptions(
        max_pose_gap_s=options.max_pose_gap_s, thin_distance_m=0.0, thin_angle_deg=0.0
    )
    largest = float(np.abs(offset).max())
    readings = synchronise(replace(recording, series=chosen), sync, largest).readings
    return with_offsets(readings, recording.trajectory, offset)


def start_pose(odometry: Trajectory, options: StartPoseOptions) -> StartPose:
    """Return where a drive begins in the map."""
    R, p = odometry.R[0], odometry.p[0]
    if options.position is not None:
        p = np.array(options.position)
    if options.quaternion_xyzw is not None:
        R = Rotation.from_quat(options.quaternion_xyzw).as_matrix()
    covariance = isotropic_covariance(options.rotation_deg, options.position_m)
    return StartPose(RigidTransform(R, p), covariance)
