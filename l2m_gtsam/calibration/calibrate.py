"""Recording + map + options -> calibration. Pure: no files, no terminal."""

from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np

from l2m_gtsam.calibration.budget.found import Budget
from l2m_gtsam.calibration.changed_places import ChangedSolve, solve_changed
from l2m_gtsam.calibration.coverage import KnowsSurvey
from l2m_gtsam.calibration.explanation import explained
from l2m_gtsam.calibration.extent import extent_of
from l2m_gtsam.calibration.jumping_solve import solve_jumping
from l2m_gtsam.calibration.moving_solve import MovingProblem
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.priors import Priors, priors_of
from l2m_gtsam.calibration.start.global_start import find_starts
from l2m_gtsam.calibration.stretch_causes import with_causes
from l2m_gtsam.calibration.trust import judged
from l2m_gtsam.calibration.verdicts import SolvedDrive, sensor_verdicts
from l2m_gtsam.calibration.view import QueryableMap, RememberedMap, for_solvers
from l2m_gtsam.data import FloatArray, Readings, Recording, SourceFile, Synchronised, Trajectory
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.maps.field_map import Summarised, check_frame
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.recording.drive_trace import trace_of
from l2m_gtsam.recording.joining import drive_at, joined_readings, own_ns
from l2m_gtsam.recording.pose_noise import pose_roots
from l2m_gtsam.recording.regressors import check_changes, with_regressors
from l2m_gtsam.recording.sync import stuck_readings, synchronise
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    Disagreement,
    FoundStart,
    SensorCalibration,
    SensorStatus,
)
from l2m_gtsam.records.error_budget import OffsetJump
from l2m_gtsam.records.provenance import RecordedDrive, dated
from l2m_gtsam.solve.explain import movement
from l2m_gtsam.solve.robust import disagreements

VERSIONED = ("l2m-gtsam", "gtsam", "numpy", "scipy", "rosbags")

COVERED = 0.5  # share of the lidar's places, above which a map is that of the drive


@dataclass(frozen=True)
class Calibrated:
    """A calibration with what it rests on.

    Attributes
    ----------
    result
        The calibration.
    solution
        Of the solve, with its readings.
    field_map, solver_map
        The map with the sources, and the form of it that is asked faster along the drive.
    """

    result: CalibrationResult
    solution: OneKeySolution
    field_map: QueryableMap
    solver_map: QueryableMap


def calibrate(
    recording: Recording,
    field_map: QueryableMap,
    options: CalibrationOptions,
    map_source: SourceFile | None = None,
    progress: Progress = silent,
) -> CalibrationResult:
    """Find where every magnetometer sits on the lidar and how it distorts the field.

    Parameters
    ----------
    recording
        A drive through the mapped place, or several of one vehicle (``joining.joined``): sensors
        then have one t, C, H and time offset over all of them.
    field_map
        The magnetic map, in the frame of the recording's poses.
    options
        Synchronisation, starts and solve.
    map_source
        Where the map came from, for the record.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    MapError
        The poses are in another frame than the map.
    SyncError
        Readings and poses do not overlap.
    CalibrationError
        No sensor can be solved: the map does not cover the drive, or nothing was read. Or a start
        or prior names no sensor of the recording.
    """
    return calibrated(recording, field_map, options, map_source, progress).result


@one_blas_thread()
def calibrated(
    recording: Recording,
    field_map: QueryableMap,
    options: CalibrationOptions,
    map_source: SourceFile | None = None,
    progress: Progress = silent,
) -> Calibrated:
    """Calibrate as ``calibrate`` does, and keep what the result rests on, to judge it by."""
    check_frame(field_map, recording, map_source.path if map_source else "the map")
    synchronised = prepare(recording, options)
    alive = synchronised.readings.select(~stuck_readings(synchronised.readings))
    compiled = for_solvers(field_map)
    solver_map = RememberedMap(compiled)
    priors = priors_of(options.priors, alive.sensors)
    found = _starts(alive, compiled, options, priors, progress)
    t_start = _start_places(alive.sensors, found, options)
    extent = extent_of(alive, solver_map, t_start, options.solve.most_weights)
    synchronised, alive = extent.accounted(synchronised, alive), alive.select(extent.counts)
    problem = MovingProblem(
        readings=alive,
        names=tuple(each.name for each in recording.scalars),
        field_map=solver_map,
        options=options.solve,
        models=options.models,
        progress=progress,
        trajectory=recording.trajectory,
        priors=priors,
    )
    jumping = solve_jumping(problem, t_start, options.changes)
    changed = solve_changed(jumping.problem, solver_map, jumping.outcome, options.changes)
    if changed.sources is not None and is_ambiguous(found, options):
        # Steel that the search did not know of makes one place look like another.
        found = _starts(alive, changed.taken_into(compiled), options, priors, progress)
    outcome, solver_map = changed.outcome, changed.solver_map
    solved_map = changed.taken_into(field_map)
    drive = SolvedDrive(
        synchronised=synchronised,
        readings=alive,
        outcome=outcome,
        explained=explained(outcome.readings, solver_map, t_start, outcome.solution, options.solve),
        starts=tuple(found),
        moved=movement(recording.trajectory.R, recording.trajectory.p),
    )
    result = _result(recording, drive, changed, solved_map, options, map_source)
    jumps = tuple(_jump_in_own_time(each, recording) for each in jumping.jumps)
    result = replace(result, jumps=jumps)
    if extent.left_out:
        taken = f"{extent.note} (`calibration.solve.most_weights`)"
        result = replace(result, notes=(*result.notes, taken))
    return Calibrated(result, outcome.solution, solved_map, solver_map)


def _result(
    recording: Recording,
    drive: SolvedDrive,
    changed: ChangedSolve,
    field_map: QueryableMap,
    options: CalibrationOptions,
    map_source: SourceFile | None,
) -> CalibrationResult:
    """Return the record of a solved drive; a CalibrationError if no sensor is solved."""
    solution, readings = drive.outcome.solution, drive.readings
    sensors = sensor_verdicts(drive, options)
    if not solution.solved:
        covered = covers(field_map, recording.trajectory)
        raise CalibrationError(_nothing_solved(recording, map_source, sensors, covered))
    stretches = _rejected_stretches(solution, changed.solver_map, options)
    return CalibrationResult(
        sensors=tuple(
            _with_noise(_with_missing(each, readings, recording), solution.readings, recording)
            for each in sensors
        ),
        iterations=solution.steps,
        uncertainty=solution.uncertainty,
        doubts=(
            *(field_map.summary.doubts if isinstance(field_map, Summarised) else ()),
            *changed.doubts,
        ),
        disagreements=tuple(_in_own_time(each, recording) for each in stretches),
        bag=None if recording.drives else recording.source,
        map=map_source,
        options=options.model_dump(mode="json"),
        versions={name: version(name) for name in VERSIONED},
        bags=tuple(drive.source for drive in recording.drives),
        notes=tuple(n for drive in recording.parts for n in (*drive.notes, *drive.origins)),
        traces=tuple(trace_of(drive.trajectory) for drive in recording.parts),
        exact=taken_for_exact(readings, field_map, solution.budget),
        disturbances=solution.budget.named(readings.sensors),
        stated=solution.stated,
        pose_duration=solution.pose_duration,
        unseen_warp_m=solution.unseen_warp_m,
        sources=changed.records,
        recorded=tuple(map(_recorded, recording.parts)),
    )


def prepare(recording: Recording, options: CalibrationOptions) -> Synchronised:
    """Return the readings that take part, their poses, how these move and how wrong they are.

    Of a vehicle that stands still, velocities are the noise of its poses: they are left out, as
    they are where clocks are known to agree. Drives that were joined are prepared one by one: a
    place that was read in one drive is read anew in the next.

    Raises
    ------
    SyncError
        Readings and poses or recorded numbers of a drive do not overlap, or a number never changes.
    """
    parts = [_prepared(drive, options) for drive in recording.parts]
    whole = joined_readings(parts, recording)
    check_changes(whole.readings, recording.scalars)
    return whole


def _prepared(recording: Recording, options: CalibrationOptions) -> Synchronised:
    """Return the same for a single drive."""
    largest, poses = options.solve.largest_offset_s, recording.trajectory
    synchronised = synchronise(recording, options.sync, largest)
    synchronised = with_regressors(synchronised, recording.scalars, options.regressors)
    readings = synchronised.readings
    still = movement(poses.R, poses.p).at_rest
    readings = replace(
        readings,
        motion=None if still or not largest else readings.motion,
        pose_root=pose_roots(poses, readings.stamp_ns, options.solve.pose_noise),
    )
    return replace(synchronised, readings=readings)


def _rejected_stretches(
    solution: OneKeySolution, solver_map: QueryableMap, options: CalibrationOptions
) -> tuple[Disagreement, ...]:
    """Return the stretches of rejected readings with what explains them."""
    verdicts = judged(solution.readings, solver_map, solution.estimate, solution.rejected)
    return with_causes(disagreements(verdicts), solution, solver_map, options.changes)


def taken_for_exact(readings: Readings, field_map: QueryableMap, budget: Budget) -> tuple[str, ...]:
    """Return what sigmas know no errors of, for want of stated or found ones."""
    known = readings.pose_root is not None or budget.poses is not None
    drive = () if known else ("the drive's poses",)
    survey = field_map if isinstance(field_map, KnowsSurvey) else None
    sensors = () if survey and survey.sensors_uncertain else ("the survey's sensors",)
    poses = () if survey and survey.poses_uncertain else ("the survey's poses",)
    return (*drive, *sensors, *poses)


def _recorded(drive: Recording) -> RecordedDrive:
    """Return when a drive was recorded, and in which frames."""
    poses = drive.trajectory
    when = dated(int(poses.stamp_ns[0]), int(poses.stamp_ns[-1]))
    return RecordedDrive(when, poses.frame, poses.child_frame, drive.poses)


def _starts(
    readings: Readings,
    field_map: QueryableMap,
    options: CalibrationOptions,
    priors: Priors,
    progress: Progress,
) -> list[FoundStart | None]:
    """Look for the start of each sensor; none where it is given or none is found."""
    check_starts(readings.sensors, options)
    if not len(readings) or set(options.start) == set(readings.sensors):
        return [None] * len(readings.sensors)
    progress("global start", 0.0)
    found = find_starts(readings, field_map, np.zeros(3), options.search, priors)
    progress("global start", 1.0)
    names = zip(readings.sensors, found, strict=True)
    return [None if name in options.start else each for name, each in names]


def check_starts(sensors: tuple[str, ...], options: CalibrationOptions) -> None:
    """Raise a CalibrationError for a start of a sensor that the recording does not have."""
    if unknown := sorted(set(options.start) - set(sensors)):
        msg = f"start: no sensor named {unknown[0]!r}; the recording has {', '.join(sensors)}"
        raise CalibrationError(msg)


def is_ambiguous(found: list[FoundStart | None], options: CalibrationOptions) -> bool:
    """Return whether readings leave it open where any sensor started."""
    return any(each is not None and each.ambiguous(options.search.clear) for each in found)


def _start_places(
    sensors: tuple[str, ...], found: list[FoundStart | None], options: CalibrationOptions
) -> FloatArray:
    """Return where each sensor starts, shape (S, 3), metres: given, found, or the lidar."""
    at_lidar = (0.0, 0.0, 0.0)
    return np.array(
        [
            options.start.get(name, at_lidar) if each is None else each.t_lidar_mag
            for name, each in zip(sensors, found, strict=True)
        ]
    )


def _with_missing(
    sensor: SensorCalibration, readings: Readings, recording: Recording
) -> SensorCalibration:
    """Return the same with the drives in which nothing usable was read of it."""
    own = readings.of_drive[readings.rows_of(readings.sensors.index(sensor.sensor))]
    missing = [drive.source.path for k, drive in enumerate(recording.drives) if k not in own]
    return replace(sensor, missing_in=tuple(missing)) if missing else sensor


def _with_noise(
    sensor: SensorCalibration, readings: Readings, recording: Recording
) -> SensorCalibration:
    """Return the same with its noise on each drive, where that differs."""
    own = readings.alone(readings.sensors.index(sensor.sensor))
    if (own.noise_ratio == 1).all():
        return sensor
    sizes = np.full(len(recording.drives), sensor.noise)
    sizes[own.of_drive] = sensor.noise * own.noise_ratio
    return replace(sensor, drive_noise=tuple(sizes.tolist()))


def _in_own_time(stretch: Disagreement, recording: Recording) -> Disagreement:
    """Return a stretch with the name of its drive, in that one's time."""
    if not recording.drives:
        return stretch
    drive = recording.drives[drive_at(recording, stretch.start_ns)]
    start, end = (own_ns(recording, each) for each in (stretch.start_ns, stretch.end_ns))
    return replace(stretch, start_ns=start, end_ns=end, bag=drive.source.path)


def _jump_in_own_time(jump: OffsetJump, recording: Recording) -> OffsetJump:
    """Return a jump with the name of its drive, in that one's time."""
    if not recording.drives:
        return jump
    drive = recording.drives[drive_at(recording, jump.stamp_ns)]
    stamp = own_ns(recording, jump.stamp_ns)
    seconds = 1e-9 * (stamp - int(drive.trajectory.stamp_ns[0]))
    return replace(jump, stamp_ns=stamp, seconds=seconds, bag=drive.source.path)


def _nothing_solved(
    recording: Recording,
    map_source: SourceFile | None,
    sensors: tuple[SensorCalibration, ...],
    covered: bool,
) -> str:
    """Return why; ``covered`` is whether the map has data where the lidar was."""
    place = map_source.path if map_source else "the map"
    unsolved = f"{recording.source.path}: no sensor can be solved"
    outside = [each for each in sensors if each.status is SensorStatus.OUTSIDE_MAP]
    first = (outside or sensors)[0]
    if covered and outside:
        return (
            f"{unsolved}, although {place} covers the drive: {first.sensor}: {first.message}; is "
            "it the map of another place, or is the start of a sensor wrong?"
        )
    if outside:
        return not_covered(recording, place)
    return f"{unsolved}: {first.sensor}: {first.message}"


def covers(field_map: QueryableMap, poses: Trajectory) -> bool:
    """Return whether a map has data where the lidar was, most of the time."""
    return bool(np.mean(field_map.query(poses.p).inside) > COVERED)


def not_covered(recording: Recording, place: str) -> str:
    """Return that a map, by its name, is not that of the drive, and where the drive was."""
    low, high = recording.trajectory.p.min(axis=0), recording.trajectory.p.max(axis=0)
    return (
        f"{place} does not cover the drive {recording.source.path}, which runs from "
        f"({low[0]:.1f}, {low[1]:.1f}, {low[2]:.1f}) to ({high[0]:.1f}, {high[1]:.1f}, "
        f"{high[2]:.1f}) m in frame {recording.trajectory.frame!r}: is it another place or "
        "another map frame?"
    )
