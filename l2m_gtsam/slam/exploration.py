"""Recording + calibration -> poses and the field along them, without a map. Pure."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FloatArray, Recording, SourceFile
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import Explored, LocalisationResult, LocalisationStatus
from l2m_gtsam.records.scans import ScanEvidence
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import NO_SCANS, prepared
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import solve_pose_graph
from l2m_gtsam.slam.result import localisation_result
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.unknown_field.tiled_smoother import map_drive
from l2m_gtsam.slam.unknown_field.tiles import drive_prior

NO_REVISITS = "no place was come to twice: readings of an unknown field take out little drift then"
NO_FIELD = (
    "no field explains the readings at poses that odometry allows: is the calibration that of "
    "these sensors, and does the odometry jump?"
)
# Of the first pose, rad^2 and m^2, where nothing is said of it: it is what poses are told from.
HERE = np.diag(np.repeat([1e-4, 1e-3], 3) ** 2)


@dataclass(frozen=True)
class Exploration:
    """A drive through a place without a map.

    Attributes
    ----------
    result
        The poses, and what else is told.
    solution
        Of the graph.
    points, field
        Where readings that count were taken, in metres, and the field there in uT, in the map,
        shapes (N, 3).
    """

    result: LocalisationResult
    solution: DriveSolution
    points: FloatArray
    field: FloatArray


@one_blas_thread()
def explore(
    recording: Recording,
    calibration: CalibrationResult,
    options: SlamOptions,
    progress: Progress,
    calibration_source: SourceFile | None = None,
    evidence: ScanEvidence = NO_SCANS,
) -> Exploration:
    """Find where a vehicle was and what the field is there, from where its odometry begins.

    Parameters
    ----------
    recording
        A drive; its poses are odometry.
    calibration
        Of the sensors.
    options
        Key poses, odometry, start, tiles, and what becomes of the calibration. Where no start is
        given, poses and their sigmas are those from the first pose on.
    progress
        Called with a stage and the fraction of it that is done.
    calibration_source
        For the record.
    seen
        Loops that the drive's scans close.

    Raises
    ------
    CalibrationError
        No sensor of the recording is calibrated.
    SyncError
        Readings and poses do not overlap, or there are fewer than two poses.
    MapError
        There are too few readings to learn a prior of the field from.
    ConfigError
        The start is to be looked for, in no map.
    """
    if options.start.anywhere:
        raise ConfigError("`slam.start.anywhere` looks for the start in a map: give one with --map")
    drive, notes = prepared(recording, calibration, options, evidence)
    if options.start.position is None and options.start.quaternion_xyzw is None:
        drive = replace(drive, start=replace(drive.start, covariance=HERE))
    progress("learning the field's prior", 0.0)
    scaled = drive.with_scale_as_drift(options.drift.over_m)
    by_scans = solve_pose_graph(scaled, options.robust.confidence)
    drive = replace(drive, links=drive.links[by_scans.believed])
    prior = drive_prior(drive, by_scans.poses, options.tiles)
    progress("learning the field's prior", 1.0)
    mapped = map_drive(drive, by_scans.poses, prior, options, progress)
    refined = options.calibration is CalibrationUse.REFINED
    kept = calibration if refined else None
    result = localisation_result(drive, mapped.solution, by_scans, kept)
    explored = Explored(mapped.tiles, len(mapped.returns) / len(drive))
    result = replace(
        told(result, explored),
        notes=(*notes, *result.notes, *([] if explored.returned else [NO_REVISITS])),
        bag=recording.source,
        calibration_source=calibration_source,
        explored=explored,
    )
    points, field = surveyed(mapped.solution.drive, mapped.solution)
    return Exploration(result, mapped.solution, points, field)


def told(result: LocalisationResult, explored: Explored) -> LocalisationResult:
    """Return a result that says of the field that was met what it says of a map."""
    if result.status is LocalisationStatus.LOCALISED:
        message = (
            f"{explored.tiles} tiles of field; {explored.returned:.0%} of the key poses lie where "
            "the vehicle had been before"
        )
        return replace(result, message=message)
    if result.status is LocalisationStatus.NOT_CONVERGED:
        return result
    return replace(result, status=LocalisationStatus.NOT_CONVERGED, message=NO_FIELD)


def surveyed(drive: Drive, solution: DriveSolution) -> tuple[FloatArray, FloatArray]:
    """Return places in metres and the field there in uT of the readings that count, (N, 3)."""
    rows = np.flatnonzero(solution.used)
    where = solution.prediction.placed
    return where.x[rows], where.field(drive.sensors)[rows]
