"""What a drive will determine, from its poses and the map alone. Pure: no files, no terminal."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.calibrate import check_starts, covers, not_covered, prepare
from l2m_gtsam.calibration.explanation import from_priors, undetermined
from l2m_gtsam.calibration.extent import extent_of
from l2m_gtsam.calibration.forecast import Forecast, forecast
from l2m_gtsam.calibration.joint import SensorSolution
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.priors import Priors, priors_of
from l2m_gtsam.calibration.start.rigid_groups import placed
from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import (
    FieldSeries,
    FloatArray,
    LidarMotion,
    Readings,
    Recording,
    SourceFile,
    SyncCounts,
    Synchronised,
    Trajectory,
    joined_rows,
)
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.geometry import polar_rotation
from l2m_gtsam.maps.field_map import Summarised, check_frame
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.planning.motion import (
    ExtraMotion,
    PlanOptions,
    extra_motions,
    loop,
    places_around,
    strongest,
)
from l2m_gtsam.progress import Progress, reported, silent
from l2m_gtsam.records.plan import DrivePlan, MotionPlan, NoiseSource, SensorPlan, Worst
from l2m_gtsam.solve.explain import Movement, held_offset, movement
from l2m_gtsam.solve.rank import PARAMETERS, RankOptions

NANOSECONDS = 1e9
BREAK_NS = 60_000_000_000  # between a drive and a motion that is added to it
UNKNOWN = np.diag(np.full(len(PARAMETERS), np.inf))
OF_A_MOTION = 2500  # numbers of the map's errors: there are several motions to compare
NOISE_FACT = "noise of a reading (uT)"  # of the summary of maps that learn it


@dataclass(frozen=True)
class Task:
    """What every forecast of one plan has in common.

    Attributes
    ----------
    field_map
        The map, in its form for solvers.
    t
        Assumed places of the sensors in the lidar frame in metres, shape (S, 3).
    noise
        Of the sensors in uT.
    options
        How the solve would go.
    priors
        What is known of the sensors beforehand.
    """

    field_map: QueryableMap
    t: FloatArray
    noise: float
    options: CalibrationOptions
    priors: Priors

    def forecast(self, readings: Readings) -> Forecast:
        """Return the covariances that a solve would have."""
        options = self.options.solve
        return forecast(readings, self.field_map, self.t, self.noise, options, self.priors)

    def worst(self, readings: Readings) -> Worst:
        """Return what would be known least of a sensor by itself."""
        solved = self.forecast(readings).solved
        covariance = solved[0].covariance if solved else UNKNOWN
        return worst(readings.sensors[0], covariance, self.options.solve.rank)

    def of(self, sensor: int) -> "Task":
        """Return the task of one sensor by itself: baselines to others are left out."""
        return replace(self, t=self.t[[sensor]], priors=self.priors.of_one(sensor))


@one_blas_thread()
def plan(
    recording: Recording,
    field_map: QueryableMap,
    options: CalibrationOptions,
    planning: PlanOptions,
    progress: Progress = silent,
) -> DrivePlan:
    """Say what a drive will determine, to what sigma, and which extra motion would help most.

    Parameters
    ----------
    recording
        The drive; of its readings only the times count.
    field_map
        The magnetic map, in the frame of the recording's poses.
    options
        How it would be calibrated; sensors are assumed where ``start`` puts them, else where they
        were measured, else at the lidar, without distortion.
    planning
        What is assumed and tried.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    MapError
        The poses are in another frame than the map.
    SyncError
        Readings and poses do not overlap.
    CalibrationError
        The map does not cover the drive, or a place is given for an unknown sensor.
    """
    check_frame(field_map, recording)
    synchronised = prepare(recording, options)
    readings = synchronised.readings
    solver_map = for_solvers(field_map)
    noise, noise_source = _noise(field_map, options, planning)
    priors = priors_of(options.priors, readings.sensors)
    t = _places(readings.sensors, options, priors)
    extent = extent_of(readings, solver_map, t, options.solve.most_weights)
    counted = readings.select(extent.counts)
    synchronised = replace(extent.accounted(synchronised, readings), readings=counted)
    readings = counted
    task = Task(solver_map, t, noise, options, priors)
    with reported("what the drive determines", progress):
        found = task.forecast(readings)
    if not found.view.inside.any():
        raise CalibrationError(_outside(recording, task, readings.sensors))
    sensors = _sensor_plans(synchronised, recording.trajectory, found, task)
    worsts = [worst(each.sensor, each.covariance, options.solve.rank) for each in sensors]
    read = np.unique(readings.sensor).tolist()
    least = max(read, key=lambda index: worsts[index].badness)
    # The other sensors are known better: what a motion does for them need not be asked.
    one, alone = task.of(least), readings.alone(least)
    alone = alone.select(extent_of(alone, solver_map, one.t, OF_A_MOTION).counts)
    motions = _with_motions(one, alone, _motions(alone, solver_map, planning), progress)
    return DrivePlan(
        sensors=sensors,
        noise=noise,
        noise_source=noise_source,
        uncertainty=found.uncertainty,
        worst=one.worst(alone),
        motions=motions,
        doubts=field_map.summary.doubts if isinstance(field_map, Summarised) else (),
        notes=(extent.note,) if extent.left_out else (),
    )


def _outside(recording: Recording, task: Task, sensors: tuple[str, ...]) -> str:
    """Return why the map knows nothing of any sensor."""
    if not covers(task.field_map, recording.trajectory):
        return not_covered(recording, "the map")
    places = (
        f"{name} ({t[0]:g}, {t[1]:g}, {t[2]:g})" for name, t in zip(sensors, task.t, strict=True)
    )
    return (
        f"the map covers the drive {recording.source.path}, but no place of a sensor: "
        f"{', '.join(places)}; give metres from the lidar, in its frame, with `--at` or "
        "`calibration.start`"
    )


def _with_motions(
    task: Task, readings: Readings, motions: tuple[ExtraMotion, ...], progress: Progress
) -> tuple[MotionPlan, ...]:
    """Return what each motion would leave of a sensor, the best first."""
    plans = []
    for index, motion in enumerate(motions):
        progress("extra motions", index / len(motions))
        plans.append(MotionPlan(motion.name, task.worst(with_motion(readings, motion))))
    progress("extra motions", 1.0)
    return tuple(sorted(plans, key=lambda each: each.worst.badness))


def assumed_recording(
    trajectory: Trajectory, source: SourceFile, sensors: tuple[str, ...], rate_hz: float
) -> Recording:
    """Return a drive with sensors that it does not have yet: readings at a rate, all zero."""
    first, last = trajectory.stamp_ns[[0, -1]]
    stamps = np.arange(first, last + 1, int(NANOSECONDS / rate_hz), dtype=np.int64)
    silent = np.zeros((len(stamps), 3))
    series = tuple(FieldSeries(name, "", "", stamps, silent) for name in sensors)
    return Recording(trajectory, series, source)


def with_motion(readings: Readings, motion: ExtraMotion) -> Readings:
    """Return the readings of a drive to which a motion is added: one per sensor and pose.

    Nobody knows the recorded numbers of a motion: they are the means of the drive.
    """
    S, K = len(readings.sensors), len(motion.p)
    roots, numbers = readings.pose_root, readings.regressors
    later = BREAK_NS + np.round(NANOSECONDS * motion.seconds).astype(np.int64)
    added = Readings(
        readings.sensors,
        np.repeat(np.arange(S), K),
        np.tile(readings.stamp_ns.max() + later, S),
        np.tile(motion.R, (S, 1, 1)),
        np.tile(motion.p, (S, 1)),
        np.zeros((S * K, 3)),
        LidarMotion.steady(np.tile(motion.twist, (S, 1))),
        None if roots is None else np.tile(roots[:1], (S * K, 1, 1)),
        None if numbers is None else np.tile(numbers.mean(axis=0), (S * K, 1)),
    )
    both = joined_rows([readings, added])
    return both[np.argsort(both.sensor, kind="stable")]


def worst(sensor: str, covariance: FloatArray, rank: RankOptions) -> Worst:
    """Return the parameter of a sensor that is known least, from its covariance, (15, 15)."""
    sigma = np.sqrt(np.diag(covariance))
    known = np.isfinite(sigma)
    if not known.any():
        return Worst(len(sigma), sensor, "", float("inf"), float("inf"))
    share = np.where(known, sigma / rank.scale(), 0.0)
    least = int(np.argmax(share))
    unknown = len(sigma) - int(known.sum())
    return Worst(unknown, sensor, PARAMETERS[least], float(sigma[least]), float(share[least]))


def _noise(
    field_map: QueryableMap, options: CalibrationOptions, planning: PlanOptions
) -> tuple[float, NoiseSource]:
    """Return the noise to assume in uT: as given, else that of the mapping suite."""
    if options.solve.sensor_noise_ut is not None:
        return options.solve.sensor_noise_ut, NoiseSource.GIVEN
    facts = field_map.summary.facts if isinstance(field_map, Summarised) else {}
    if NOISE_FACT in facts:
        return float(facts[NOISE_FACT]), NoiseSource.MAP
    return planning.noise_ut, NoiseSource.ASSUMED


def _places(sensors: tuple[str, ...], options: CalibrationOptions, priors: Priors) -> FloatArray:
    """Return where sensors are assumed in metres, shape (S, 3)."""
    check_starts(sensors, options)
    at_lidar = (0.0, 0.0, 0.0)
    t = np.array([options.start.get(name, at_lidar) for name in sensors])
    given = [index for index, name in enumerate(sensors) if name in options.start]
    return placed(t, given, priors)


def _motions(
    readings: Readings, field_map: QueryableMap, planning: PlanOptions
) -> tuple[ExtraMotion, ...]:
    """Return the motions to try on a drive, by the readings of one sensor."""
    # No pose twice: the vehicle has no velocity between a pose and itself.
    stamps, first = np.unique(readings.stamp_ns, return_index=True)
    seconds = (stamps - stamps[0]) / NANOSECONDS
    drive = ExtraMotion("drive", readings.R_map_lidar[first], readings.p_map_lidar[first], seconds)
    motions = extra_motions(drive, planning.motion)
    places = places_around(drive, planning.motion)
    strong = strongest(places, field_map.query(places))
    return motions if strong is None else (*motions, loop(drive, strong, planning.motion))


def _sensor_plans(
    synchronised: Synchronised, trajectory: Trajectory, found: Forecast, task: Task
) -> tuple[SensorPlan, ...]:
    readings, solved = synchronised.readings, {each.sensor: each for each in found.solved}
    outside = np.bincount(readings.sensor[~found.view.inside], minlength=len(readings.sensors))
    moved = movement(trajectory.R, trajectory.p)
    plans = []
    for index, counts in enumerate(synchronised.counts):
        inside = counts.kept - int(outside[index])
        held, late = "", float("inf")
        known: tuple[str, ...] = ()
        if index in solved:
            covariance, words = _foretold(solved[index], found, task)
            held = held_offset(solved[index].determinacy)
            known = from_priors(solved[index].determinacy)
            late = solved[index].offset_sigma
        else:
            covariance = UNKNOWN
            words = (_too_few(counts, inside, moved, task.options.solve.min_readings),)
        plans.append(
            SensorPlan(
                sensor=readings.sensors[index],
                t_lidar_mag=task.t[index],
                readings=inside,
                outside_map=int(outside[index]),
                covariance=covariance,
                rotation_covariance=_of_rotation(index, covariance, task),
                undetermined=words,
                offset_sigma=late,
                offset_held=held,
                from_priors=known,
            )
        )
    return tuple(plans)


def _of_rotation(sensor: int, covariance: FloatArray, task: Task) -> FloatArray:
    """Return the covariance of an ideal sensor's rotation, shape (3, 3), in rad^2."""
    R_mag_lidar = task.priors.mounts().get(sensor, np.eye(3))
    return polar_rotation(R_mag_lidar, covariance[3:12, 3:12]).covariance


def _foretold(
    solution: SensorSolution, found: Forecast, task: Task
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return a sensor's covariance, and in words what it leaves open."""
    used = found.view.readings.select(found.view.readings.sensor == solution.sensor)
    t, rank = task.t[solution.sensor], task.options.solve.rank
    words = undetermined(solution.determinacy, used, t, task.field_map, rank)
    return solution.covariance, words


def _too_few(counts: SyncCounts, inside: int, moved: Movement, needed: int) -> str:
    """Say why nothing will be known of a sensor."""
    if moved.at_rest:
        return f"everything: {moved.rest}"
    return (
        f"everything: {inside} of {counts.kept} places lie inside the map, at least {needed} must "
        f"({counts.received} readings in all)"
    )
