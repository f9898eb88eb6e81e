"""Recording + map + options -> calibration. Pure: no files, no terminal."""

from dataclasses import replace
from importlib.metadata import version

import numpy as np

from l2m_gtsam.config import CalibrationOptions
from l2m_gtsam.data import (
    Distortion,
    FloatArray,
    Readings,
    Recording,
    SourceFile,
    SyncCounts,
    Synchronised,
)
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.graph.alternation import OneKeyOptions, Progress
from l2m_gtsam.graph.contradictions import Contradiction
from l2m_gtsam.graph.explanation import Explained, explained
from l2m_gtsam.graph.global_start import find_starts
from l2m_gtsam.graph.moving_solve import MovingProblem, MovingSolution, solve_moving
from l2m_gtsam.graph.named_priors import priors_of
from l2m_gtsam.graph.one_key import OneKeySolution
from l2m_gtsam.graph.priors import Priors
from l2m_gtsam.graph.trust import judged
from l2m_gtsam.graph.view import Compilable, QueryableMap
from l2m_gtsam.maps.field_map import Summarised
from l2m_gtsam.prepare import prepare
from l2m_gtsam.results import (
    CalibrationResult,
    FoundStart,
    SensorCalibration,
    SensorStatus,
    TimeOffset,
)
from l2m_gtsam.solve.disagreement import disagreements
from l2m_gtsam.solve.explain import Movement, movement
from l2m_gtsam.solve.rotation import PolarRotation, dead_axis, polar_rotation
from l2m_gtsam.sync import stuck_sensors

# A Newton step of a tenth of a standard deviation would still be worth taking.
CONVERGED_SIGMAS = 0.1

# Squared distance of two sensors in sigmas, three degrees of freedom: exceeded by 1 % of those at
# one point.
ONE_POINT = 11.3

# With more of its readings rejected than this, what a sensor's others agree on may be chance.
MOST_REJECTED = 0.4

UNSOLVED = "the sensor is not solved"
VERSIONED = ("l2m-gtsam", "gtsam", "numpy", "scipy", "rosbags")


def calibrate(
    recording: Recording,
    field_map: QueryableMap,
    options: CalibrationOptions,
    map_source: SourceFile | None = None,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Find where every magnetometer sits on the lidar and how it distorts the field.

    Parameters
    ----------
    recording
        A drive through the mapped place.
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
    SyncError
        Readings and poses do not overlap.
    CalibrationError
        No sensor can be solved: the map does not cover the drive, or nothing was read. Or a start
        or prior names no sensor of the recording.
    """
    synchronised = prepare(recording, options)
    stuck = stuck_sensors(synchronised.readings)
    alive = synchronised.readings.select(~np.isin(synchronised.readings.sensor, stuck))
    solver_map = field_map.compile() if isinstance(field_map, Compilable) else field_map
    priors = priors_of(options.priors, alive.sensors)
    found = _starts(alive, solver_map, options, priors, progress)
    t_start = _start_places(alive.sensors, found, options)
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
    outcome = solve_moving(problem, t_start)
    solution = outcome.solution
    told = explained(outcome.readings, solver_map, t_start, solution, options.solve)
    moved = movement(recording.trajectory.R, recording.trajectory.p)
    sensors = _assess(synchronised, alive, solution, told, moved, options)
    sensors = tuple(_with_models(index, each, outcome) for index, each in enumerate(sensors))
    missed = {alive.sensors[each.sensor]: each.contradictions for each in solution.solved}
    sensors = tuple(
        _with_contradictions(each, missed.get(each.sensor, ()), alive.sensors) for each in sensors
    )
    sensors = tuple(_with_start(*each, options) for each in zip(sensors, found, strict=True))
    sensors = tuple(_with_neighbours(sensor, sensors) for sensor in sensors)
    if not solution.solved:
        raise CalibrationError(_nothing_solved(recording, map_source, sensors))
    verdicts = judged(solution.readings, solver_map, solution.estimate, solution.rejected)
    return CalibrationResult(
        sensors=sensors,
        iterations=solution.steps,
        uncertainty=solution.uncertainty,
        doubts=field_map.summary.doubts if isinstance(field_map, Summarised) else (),
        disagreements=disagreements(verdicts),
        bag=recording.source,
        map=map_source,
        options=options.model_dump(mode="json"),
        versions={name: version(name) for name in VERSIONED},
    )


def _starts(
    readings: Readings,
    field_map: QueryableMap,
    options: CalibrationOptions,
    priors: Priors,
    progress: Progress | None,
) -> list[FoundStart | None]:
    """Look for the start of each sensor; none where it is given or none is found.

    Raises
    ------
    CalibrationError
        A start is given for a sensor that the recording does not have.
    """
    if unknown := sorted(set(options.start) - set(readings.sensors)):
        sensors = ", ".join(readings.sensors)
        msg = f"start: no sensor named {unknown[0]!r}; the recording has {sensors}"
        raise CalibrationError(msg)
    if not len(readings) or set(options.start) == set(readings.sensors):
        return [None] * len(readings.sensors)
    tell = progress or (lambda stage, fraction: None)
    tell("global start", 0.0)
    found = find_starts(readings, field_map, np.zeros(3), options.search, priors)
    tell("global start", 1.0)
    names = zip(readings.sensors, found, strict=True)
    return [None if name in options.start else each for name, each in names]


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


def _with_models(
    index: int, sensor: SensorCalibration, outcome: MovingSolution
) -> SensorCalibration:
    """Return the same with its models and what recorded numbers add to its readings."""
    return replace(
        sensor,
        models=outcome.compared.get(index),
        not_compared=outcome.not_compared.get(index, "" if index in outcome.compared else UNSOLVED),
        moving=outcome.moving.get(index, ()),
    )


def _with_start(
    sensor: SensorCalibration, start: FoundStart | None, options: CalibrationOptions
) -> SensorCalibration:
    """Return the same with where it started, and a warning if that was not the only place."""
    clear = options.search.clear
    if start is None or start.runner_up is None or not start.ambiguous(clear):
        return replace(sensor, start=start)
    if sensor.status is not SensorStatus.SOLVED:
        return replace(sensor, start=start)
    place = ", ".join(f"{value:.2f}" for value in start.runner_up)
    msg = (
        f"another place, ({place}) m, explains the readings about as well: it leaves "
        f"{start.margin:.2f} times as much; give `calibration.start` or drive more varied ways"
    )
    return replace(sensor, start=start, status=SensorStatus.AMBIGUOUS, message=msg)


def _with_contradictions(
    sensor: SensorCalibration, missed: tuple[Contradiction, ...], names: tuple[str, ...]
) -> SensorCalibration:
    """Return the same with a word on what was known beforehand and the readings speak against."""
    if not missed:
        return sensor
    worst = max(missed, key=lambda each: each.sigmas)
    others = [names[each] for each in worst.sensors if names[each] != sensor.sensor]
    where = f" with {others[0]}" if others else ""
    msg = (
        f"its {worst.kind}{where} contradicts the readings by {worst.sigmas:.1f} sigmas: correct "
        "`calibration.priors`, or give it a larger sigma"
    )
    if sensor.status is not SensorStatus.SOLVED:
        return replace(sensor, message=f"{sensor.message}; {msg}")
    return replace(sensor, status=SensorStatus.CONTRADICTED, message=msg)


def _with_neighbours(
    sensor: SensorCalibration, others: tuple[SensorCalibration, ...]
) -> SensorCalibration:
    """Return the same with a word on sensors at the same point: no baseline between them."""
    names = [other.sensor for other in others if _at_one_point(sensor, other)]
    if not names:
        return sensor
    place = f"its place is not told apart from {', '.join(names)}"
    return replace(sensor, message=f"{sensor.message}; {place}")


def _at_one_point(one: SensorCalibration, other: SensorCalibration) -> bool:
    """Whether two solved sensors lie so close that their sigmas do not separate them."""
    solved = SensorStatus.SOLVED
    if one is other or not one.status is other.status is solved:
        return False
    apart = one.t_lidar_mag - other.t_lidar_mag
    covariance = one.covariance[:3, :3] + other.covariance[:3, :3]
    return bool(apart @ np.linalg.solve(covariance, apart) < ONE_POINT)


def _assess(
    synchronised: Synchronised,
    alive: Readings,
    solution: OneKeySolution,
    solved: dict[int, Explained],
    moved: Movement,
    options: CalibrationOptions,
) -> tuple[SensorCalibration, ...]:
    """Return a verdict on every sensor of the recording."""
    outside = np.bincount(alive.sensor[~solution.inside], minlength=len(alive.sensors))
    rejected = np.bincount(alive.sensor[solution.rejected], minlength=len(alive.sensors))
    sensors = []
    for index, (name, counts) in enumerate(zip(alive.sensors, synchronised.counts, strict=True)):
        if index in solved:
            entry = _solved(
                name, solved[index], solution, counts, int(outside[index]), options.solve
            )
        else:
            usable = alive.rows_of(index)
            read = usable.stop - usable.start
            needed = options.solve.min_readings
            entry = _unsolved(name, read, counts, int(outside[index]), moved, needed)
        sensors.append(_with_rejected(entry, int(rejected[index])))
    return tuple(sensors)


def _with_rejected(sensor: SensorCalibration, rejected: int) -> SensorCalibration:
    """Return the same with the number of its readings that nothing explains, and what follows."""
    sensor = replace(sensor, rejected=rejected)
    used = 0 if sensor.residuals is None else sensor.residuals.readings
    if rejected <= MOST_REJECTED * (used + rejected):
        return sensor
    msg = (
        f"{rejected} of {used + rejected} readings inside the map fit no distortion that explains "
        "the others: is it the right map, and are the poses in its frame?"
    )
    if sensor.status not in (SensorStatus.SOLVED, SensorStatus.OUTSIDE_MAP):
        return sensor
    return replace(sensor, status=SensorStatus.CONTRADICTED, message=msg)


def _solved(
    name: str,
    told: Explained,
    solution: OneKeySolution,
    counts: SyncCounts,
    outside: int,
    options: OneKeyOptions,
) -> SensorCalibration:
    found = told.solution
    vector = solution.estimate.distortion[found.sensor]
    distortion = Distortion.from_vector(vector)
    status, message = _verdict(told, solution, options)
    rotation = _no_rotation()
    axis = dead_axis(distortion.C)
    # what is not determined may be short without a fault of the sensor
    if axis and np.isfinite(found.covariance[3:12, 3:12].diagonal()).all():
        status = SensorStatus.DEAD_AXIS
        message = f"the sensor's {axis} axis does not follow the field; check its wiring"
    else:
        try:
            rotation = polar_rotation(distortion.C, found.covariance[3:12, 3:12])
        except CalibrationError as error:
            # the sign of a C that is not known says nothing about the axes
            if status is SensorStatus.SOLVED:
                status, message = SensorStatus.FLIPPED_AXIS, str(error)
    return SensorCalibration(
        sensor=name,
        status=status,
        message=message,
        t_lidar_mag=solution.estimate.t[found.sensor],
        distortion=distortion,
        R_lidar_mag=np.ascontiguousarray(rotation.R_mag_lidar.T),
        covariance=found.covariance,
        rotation_covariance=rotation.covariance,
        noise=float(solution.estimate.noise[found.sensor]),
        residuals=found.figures,
        undetermined=told.words,
        sync=counts,
        outside_map=outside,
        time_offset=_time_offset(told, solution),
        from_priors=told.from_priors,
    )


def _time_offset(told: Explained, solution: OneKeySolution) -> TimeOffset:
    found = told.solution
    return TimeOffset(
        seconds=0.0 if told.held else float(solution.estimate.offset[found.sensor]),
        sigma=found.offset_sigma,
        cross_covariance=found.offset_covariance,
        held=told.held,
    )


def _verdict(
    told: Explained, solution: OneKeySolution, options: OneKeyOptions
) -> tuple[SensorStatus, str]:
    found, words = told.solution, ". ".join(told.words)
    open_ = f"this drive and map leave open: {words}" if words else ""
    because = f"; {open_}" if words else ""
    if abs(solution.estimate.offset[found.sensor]) >= options.largest_offset_s > 0:
        return SensorStatus.NOT_CONVERGED, (
            f"its clock seems to be off by {options.largest_offset_s:g} s or more: correct its "
            f"stamps, or raise `calibration.solve.largest_offset_s`{because}"
        )
    if not solution.settled:
        return SensorStatus.NOT_CONVERGED, (
            f"estimate and weights still change, round after round{because}"
        )
    if found.remaining_sigmas > CONVERGED_SIGMAS:
        return SensorStatus.NOT_CONVERGED, (
            f"{solution.ending.value}, {found.remaining_sigmas:.2g} standard deviations from the "
            f"optimum{because}"
        )
    if words:
        return SensorStatus.UNDETERMINED, open_
    known = f"; from priors: {', '.join(told.from_priors)}" if told.from_priors else ""
    return SensorStatus.SOLVED, f"converged on {found.figures.readings} readings{known}"


def _unsolved(
    name: str, usable: int, counts: SyncCounts, outside: int, moved: Movement, needed: int
) -> SensorCalibration:
    status, message = (
        SensorStatus.OUTSIDE_MAP,
        (f"{outside} of {usable} readings lie outside the map, at least {needed} must lie inside"),
    )
    if usable < needed:
        status, message = SensorStatus.NO_READINGS, _why_silent(usable, counts, moved, needed)
    rotation = _no_rotation()
    return SensorCalibration(
        sensor=name,
        status=status,
        message=message,
        t_lidar_mag=np.full(3, np.nan),
        distortion=Distortion(np.full((3, 3), np.nan), np.full(3, np.nan)),
        R_lidar_mag=rotation.R_mag_lidar.T,
        covariance=np.diag(np.full(15, np.inf)),
        rotation_covariance=rotation.covariance,
        noise=float("nan"),
        residuals=None,
        undetermined=(),
        sync=counts,
        outside_map=outside,
    )


def _why_silent(usable: int, counts: SyncCounts, moved: Movement, needed: int) -> str:
    if counts.kept >= needed:
        return "the sensor reports one constant value: it is stuck"
    reason = f"{moved.rest}: " if moved.at_rest else ""
    without = counts.without_regressor
    numbers = f", {without} without a recorded number" if without else ""
    return (
        f"{reason}{usable} usable readings of {counts.received} received "
        f"({counts.not_finite} not finite, {counts.repeated} repeated, "
        f"{counts.outside_trajectory} without a pose, {counts.in_pose_gap} in a gap between poses, "
        f"{counts.thinned} at a place already read{numbers}), at least {needed} are needed"
    )


def _no_rotation() -> PolarRotation:
    return PolarRotation(np.full((3, 3), np.nan), np.diag(np.full(3, np.inf)))


def _nothing_solved(
    recording: Recording, map_source: SourceFile | None, sensors: tuple[SensorCalibration, ...]
) -> str:
    place = map_source.path if map_source else "the map"
    if any(sensor.status is SensorStatus.OUTSIDE_MAP for sensor in sensors):
        low, high = recording.trajectory.p.min(axis=0), recording.trajectory.p.max(axis=0)
        return (
            f"{place} does not cover the drive {recording.source.path}, which runs from "
            f"({low[0]:.1f}, {low[1]:.1f}, {low[2]:.1f}) to ({high[0]:.1f}, {high[1]:.1f}, "
            f"{high[2]:.1f}) m in frame {recording.trajectory.frame!r}: is it another place or "
            "another map frame?"
        )
    return f"{recording.source.path}: no sensor can be solved: {sensors[0].message}"
