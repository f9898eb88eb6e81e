"""Estimate poses and field of a recording together, without a map. Pure: no files."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import Explored, LocalisationResult, LocalisationStatus
from l2m_gtsam.records.scans import ScanEvidence
from l2m_gtsam.slam.drift import plane_hints
from l2m_gtsam.slam.drive import EXACT_START, Drive, KnownSensors
from l2m_gtsam.slam.held_calibration import held_notes, with_calibration_use
from l2m_gtsam.slam.key_pose_readings import mean_readings
from l2m_gtsam.slam.localisation import NO_SCANS, Localisation, prepared
from l2m_gtsam.slam.options import NEEDS_MAP, CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import PoseGraph, solve_pose_graph
from l2m_gtsam.slam.result import localisation_result
from l2m_gtsam.slam.slips import judged, with_open_jumps, with_recorded_jumps
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.unknown_field.gain import with_gain
from l2m_gtsam.slam.unknown_field.joint_smoother import is_sure, solve_jointly
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise
from l2m_gtsam.slam.unknown_field.tiled_smoother import FieldSolution
from l2m_gtsam.slam.unknown_field.tiled_stages import map_drive
from l2m_gtsam.slam.unknown_field.tiles import drive_prior, larger
from l2m_gtsam.slam.unknown_field.whole_smoother import DriveLikelihood, map_whole_drive

NO_REVISITS = "no place was revisited: readings of an unknown field remove little drift then"
NOTHING_GAINED = "the poses are those of odometry, for no gain is shown"
NO_FIELD = (
    "no field explains the readings at poses that odometry allows: is the calibration that of "
    "these sensors, and does the odometry jump?"
)
# Between the noise that readings show and that which their calibrations state: what odometry and
# short waves add to the first is a tenth (simulated drives).
MISSTATED = 2.0


@one_blas_thread()
def explore(
    recording: Recording,
    calibration: CalibrationResult,
    options: SlamOptions,
    progress: Progress,
    evidence: ScanEvidence = NO_SCANS,
) -> Localisation:
    """Estimate the poses of a drive and the field along it, from where its odometry begins.

    Parameters
    ----------
    recording
        A drive; its poses are odometry.
    calibration
        Of the sensors.
    options
        Key poses, odometry, start, tiles, and whether the calibration is refined. Where no start is
        given, poses and their sigmas are relative to the first pose.
    progress
        Called with a stage and the fraction of it that is done.
    evidence
        Loop closures by the drive's scans.

    Raises
    ------
    CalibrationError
        No sensor of the recording is calibrated.
    SyncError
        Readings and poses do not overlap, or there are fewer than two poses.
    MapError
        There are too few readings to learn a prior of the field from.
    ConfigError
        The start is to be searched for, without a map.
    """
    if options.start.anywhere:
        raise ConfigError(NEEDS_MAP)
    drive, notes = prepared(recording, calibration, options, evidence)
    if not options.start.is_given:
        drive = replace(drive, start=replace(drive.start, covariance=EXACT_START))
    progress("learning the field's prior", 0.0)
    by_scans = without_field(with_open_jumps(drive), options)
    drive = replace(drive, links=drive.links[by_scans.believed])
    options = with_calibration_use(options, drive.sensors, one_field=has_one_sensor(drive))
    odometry = judged(
        drive,
        lambda each: solve_field(each, options, progress).solution,
        DriveLikelihood(drive, options) if has_one_sensor(drive) else None,
    )
    drive = odometry.drive
    found = solve_field(drive, options, progress)
    tiled, joint = where_gained(drive, found, options), None
    if has_sensors_alone(drive) and not is_sure(tiled.gain):
        means, _ = prepared(recording, calibration, options, evidence, mean_readings)
        joint = in_one_field(drive, means, found, options, progress)
    mapped = tiled if joint is None else joint
    refined = options.calibration is CalibrationUse.REFINED and mapped.is_corrected
    kept = calibration if refined else None
    result = localisation_result(drive, mapped.solution, by_scans, kept)
    # In one field C and H are estimated in any case.
    in_tiles = joint is None and not has_one_sensor(drive)
    is_held = options.calibration is CalibrationUse.FIXED and in_tiles
    held = held_notes(drive) if is_held else ()
    noise = noise_notes(mapped.noise, drive.sensors)
    level = plane_hints(recording.trajectory, options.drift, is_stated=drive.steps.stated)
    explored = Explored(len(mapped.tiled.tiles), len(mapped.returns) / len(drive))
    result = replace(
        explored_result(result, explored),
        notes=(
            *notes,
            *held,
            *odometry.notes,
            *result.notes,
            *([] if explored.returned else [NO_REVISITS]),
            *(
                []
                if mapped.gain is None or mapped.gain.shown
                else [f"{NOTHING_GAINED}: {mapped.gain.reason}"]
            ),
            *noise.warnings,
        ),
        hints=(*level, *noise.hints, *result.hints),
        bag=recording.source,
        explored=explored,
        gain=mapped.gain,
    )
    return Localisation(result, mapped.solution)


@dataclass(frozen=True)
class NoiseNotes:
    """What a drive says of its readings' noise: sentences worth a warning, and hints."""

    warnings: tuple[str, ...] = ()
    hints: tuple[str, ...] = ()


def noise_notes(found: SensorNoise | None, sensors: KnownSensors) -> NoiseNotes:
    """Return what a drive's own readings say of their noise, beside what calibrations say.

    Parameters
    ----------
    found
        By the drive, of one sensor or of all alike; None where it is given.
    sensors
        With the noise that is stated, uT.
    """
    if found is None:
        return NoiseNotes()
    stated = float(np.sqrt(np.mean(sensors.noise**2)))
    if found.slow_m > 0:  # of one sensor in one field
        own = (
            f"readings of {sensors.names[0]} are off by {found.white_ut:.2g} uT each and by "
            f"{found.slow_ut:.2g} uT that last over {found.slow_m:.2g} m of path, by the drive "
            f"itself; its calibration states {stated:.2g} uT"
        )
        return NoiseNotes(warnings=(own,))
    if found.ut > MISSTATED * stated:
        small = (
            f"at its start readings are off by {found.ut:.2g} uT each, by the drive itself; their "
            f"calibrations state {stated:.2g} uT: the noise is stated too small, or calibrations "
            "are off"
        )
        return NoiseNotes(warnings=(small,))
    if stated > MISSTATED * found.ut:
        large = (
            f"at its start readings are off by {found.ut:.2g} uT each, by the drive itself; their "
            f"calibrations state {stated:.2g} uT: with less noise stated poses would be known "
            "better"
        )
        return NoiseNotes(hints=(large,))
    return NoiseNotes()


def without_field(drive: Drive, options: SlamOptions) -> PoseGraph:
    """Solve a drive by odometry and scans alone."""
    scaled = drive.as_walk(options.drift.over_m)
    return solve_pose_graph(scaled, options.robust.confidence)


def has_one_sensor(drive: Drive) -> bool:
    """Return whether a drive has one sensor and nothing else that knows its places."""
    return len(drive.sensors.names) == 1 and not len(drive.links)


def has_sensors_alone(drive: Drive) -> bool:
    """Return whether a drive has several sensors and nothing else that knows its places."""
    return len(drive.sensors.names) > 1 and not len(drive.links)


def solve_field(drive: Drive, options: SlamOptions, progress: Progress) -> FieldSolution:
    """Estimate poses and field of a drive whose links are believed; arguments as of ``explore``."""
    poses = without_field(drive, options).poses
    if has_one_sensor(drive):
        mapped = map_whole_drive(drive, poses, options, progress)
        if mapped is not None:
            return mapped
    prior = drive_prior(drive, poses, options.tiles)
    progress("learning the field's prior", 1.0)
    return replace(map_drive(drive, poses, prior, options, progress), prior=prior)


def in_one_field(
    drive: Drive, means: Drive, tiled: FieldSolution, options: SlamOptions, progress: Progress
) -> FieldSolution | None:
    """Solve a drive of several sensors in one field; parameters as of ``solve_jointly``.

    ``means`` is the drive as it was recorded, with means of its readings.
    """
    heard = replace(drive, readings=means.readings, reading_ns=means.reading_ns)
    odometry = without_field(with_recorded_jumps(drive), options).poses
    try:
        return solve_jointly(heard, tiled, odometry, options, progress)
    except np.linalg.LinAlgError:  # tiles have a solution
        return None


def where_gained(drive: Drive, mapped: FieldSolution, options: SlamOptions) -> FieldSolution:
    """Return a solved drive; where nothing is shown to be gained, at the poses of odometry."""
    prior = mapped.prior
    if prior is None:
        return mapped
    recorded = with_recorded_jumps(drive)
    odometry = without_field(recorded, options).poses
    found = with_gain(mapped, recorded, odometry, larger(prior), options)
    if options.tiles.hyperparameters is not None:
        return found
    return replace(found, noise=SensorNoise(prior.hyperparameters.noise, 1.0, 0.0))


def explored_result(result: LocalisationResult, explored: Explored) -> LocalisationResult:
    """Return a result whose messages are about the estimated field instead of a map."""
    if result.status is LocalisationStatus.LOCALISED:
        message = (
            f"{explored.tiles} tiles of field; {explored.returned:.0%} of the key poses lie where "
            "the vehicle had been before"
        )
        return replace(result, message=message)
    if result.status is LocalisationStatus.NOT_CONVERGED:
        return result
    return replace(result, status=LocalisationStatus.NOT_CONVERGED, message=NO_FIELD)


def field_samples(solution: DriveSolution) -> tuple[FloatArray, FloatArray]:
    """Return positions in metres and field in uT of the readings that count, shapes (N, 3)."""
    rows = np.flatnonzero(solution.used)
    where = solution.prediction.placed
    return where.x[rows], where.field(solution.drive.sensors)[rows]
