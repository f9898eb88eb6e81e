"""From a localisation to the record in slam.json that reports are drawn from. Pure."""

from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import VERSIONED
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray, Readings, SourceFile, Trajectory
from l2m_gtsam.geometry import to_ros
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.qa.metrics.assemble import DRAWN, FEWEST, MOST, map_picture
from l2m_gtsam.qa.metrics.evidence import SensorEvidence
from l2m_gtsam.qa.metrics.fit import curves, fit_figures, normalised_figures, series
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.qa.metrics.trajectory import ComparedTrajectories, truth_record
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.localisation import LocalisationResult, SensorUse, StartFinding, StartSearch
from l2m_gtsam.records.localisation_file import (
    LocalisationRecord,
    OdometryRecord,
    PoseRecord,
    RefinedSensor,
    SensorRecord,
    StartCandidateRecord,
    StartRecord,
    Timeline,
)
from l2m_gtsam.records.provenance import NamedSource
from l2m_gtsam.records.record import fields_of
from l2m_gtsam.records.validation import ChiSquare
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.marginals import pose_covariances
from l2m_gtsam.slam.moved_sensors import calibration_change
from l2m_gtsam.slam.pose_graph import drive_values, odometry_graph
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.slam.solver import marginals_of
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.noise import map_covariance
from l2m_gtsam.solve.rank import PARAMETERS

NO_TRUTH = "no key pose lies between two true ones that are near enough: nothing is compared"
SPANS = 60  # limit of intervals in a timeline
POSES = 3  # least mean number of key poses in an interval
BAND = np.array([0.025, 0.975])
DIGITS = 9


@dataclass(frozen=True)
class RecordContext:
    """What a record contains beside the localisation.

    Attributes
    ----------
    calibration
        Of the sensors, before the drive.
    field_map
        The map in which the drive was localised, or which was made of it.
    options
        Configuration as plain values.
    max_pose_gap_s
        Longest gap in seconds over which true poses are interpolated.
    truth, truth_source
        Poses of the lidar in the map and their file, if they are known.
    """

    calibration: CalibrationResult
    field_map: QueryableMap
    options: dict[str, Any]
    max_pose_gap_s: float
    truth: Trajectory | None = None
    truth_source: SourceFile | None = None


@one_blas_thread()
def localisation_record(
    result: LocalisationResult, solution: DriveSolution, context: RecordContext
) -> LocalisationRecord:
    """Return what is kept of a localisation.

    Parameters
    ----------
    result
        The localisation.
    solution
        Solution of its graph.
    context
        What it was made from.
    """
    truth = None
    if context.truth is not None:
        compared = ComparedTrajectories(
            result.trajectory,
            result.odometry,
            result.by_scans,
            from_first=solution.drive.start.defines_frame,
        )
        truth = truth_record(context.truth, compared, context.max_pose_gap_s)
    now = result.calibration or context.calibration
    return LocalisationRecord(
        status=result.status,
        message=result.message,
        notes=(*result.notes, *([] if context.truth is None or truth else [NO_TRUTH])),
        drift=result.drift,
        steps=solution.odometry_chi2,
        scale=result.scale,
        map_errors_shared=isinstance(context.field_map, UncertainMap),
        sensors=tuple(_sensor(solution, now[use.sensor], use) for use in result.sensors),
        refined=_refined(context.calibration, result),
        poses=_poses(result.trajectory),
        odometry=_odometry(solution.drive, result.odometry),
        start=None if result.start is None else _start(result.start),
        explored=result.explored,
        gain=result.gain,
        hints=result.hints,
        turn=result.turn,
        scans=result.scans,
        truth=truth,
        picture=map_picture(context.field_map, result.trajectory.p),
        sources=_sources(result, context),
        versions={name: version(name) for name in VERSIONED},
        options=context.options,
    )


def _sources(result: LocalisationResult, context: RecordContext) -> tuple[NamedSource, ...]:
    files = {
        "drive": result.bag,
        "map": result.map,
        "calibration": result.calibration_source,
        "truth": context.truth_source,
    }
    return tuple(
        NamedSource(role, each.path, each.sha256)
        for role, each in files.items()
        if each is not None
    )


def _poses(at: Trajectory) -> tuple[PoseRecord, ...]:
    quaternions = Rotation.from_matrix(at.R).as_quat().tolist()
    covariance: list[Any] = [None] * len(at)
    if at.covariance is not None:
        covariance = [tuple(map(tuple, each)) for each in at.covariance.tolist()]
    poses = zip(at.stamp_ns.tolist(), at.p.tolist(), quaternions, covariance, strict=True)
    return tuple(PoseRecord(stamp, tuple(p), tuple(q), each) for stamp, p, q, each in poses)


def _start(search: StartSearch) -> StartRecord:
    margin = search.margin if np.isfinite(search.margin) else float("nan")
    return StartRecord(
        **fields_of(replace(search, margin=margin), StartFinding),
        candidates=tuple(
            StartCandidateRecord(
                p=row(each.T_map_lidar.t, DIGITS),
                quaternion_xyzw=row(Rotation.from_matrix(each.T_map_lidar.R).as_quat(), DIGITS),
                covariance=tuple(map(tuple, each.covariance.tolist())),
                log_likelihood=each.log_likelihood,
                inside=each.inside,
                explained=each.explained,
                chi2_per_dof=each.chi2_per_dof,
            )
            for each in search.candidates
        ),
    )


def _odometry(drive: Drive, at: Trajectory) -> tuple[OdometryRecord, ...]:
    quaternions = Rotation.from_matrix(at.R).as_quat()
    variance = np.diagonal(to_ros(odometry_covariance(drive), at.R), axis1=1, axis2=2)
    sigma = np.sqrt(variance) * np.repeat([1.0, np.rad2deg(1.0)], 3)
    return tuple(
        OdometryRecord(row(p, DIGITS), row(q, DIGITS), row(each, DIGITS))
        for p, q, each in zip(at.p, quaternions, sigma, strict=True)
    )


def odometry_covariance(drive: Drive) -> FloatArray:
    """Return the covariance of each key pose by odometry alone, shape (K, 6, 6).

    Of right perturbations, rotation (rad) before translation (m).
    """
    graph, values = odometry_graph(drive), drive_values(drive, drive.dead_reckoning())
    return pose_covariances(marginals_of(graph, values), len(drive))


def _refined(before: CalibrationResult, result: LocalisationResult) -> tuple[RefinedSensor, ...]:
    if result.calibration is None:
        return ()
    names = [each.sensor for each in result.sensors]
    return tuple(_change(before[name], result.calibration[name]) for name in names)


def _change(before: SensorCalibration, after: SensorCalibration) -> RefinedSensor:
    old, new = (each.vector() for each in (before, after))
    low, high = quantile(BAND, len(PARAMETERS))
    return RefinedSensor(
        sensor=before.sensor,
        before=row(old, DIGITS),
        sigma_before=row(np.sqrt(np.diag(before.covariance)), DIGITS),
        after=row(new, DIGITS),
        sigma_after=row(np.sqrt(np.diag(after.covariance)), DIGITS),
        change=ChiSquare(
            calibration_change(before, after), len(PARAMETERS), float(low), float(high)
        ),
    )


def _sensor(solution: DriveSolution, sensor: SensorCalibration, use: SensorUse) -> SensorRecord:
    index = solution.drive.sensors.names.index(sensor.sensor)
    own = np.flatnonzero(solution.drive.readings.sensor == index)
    timeline = _timeline(solution, own)
    if not use.used:
        return SensorRecord(use, timeline, None, None, None)
    inside = own[solution.prediction.inside[own]]
    evidence = sensor_evidence(solution, inside)
    most = int(np.clip(DRAWN // len(solution.drive.sensors.names), FEWEST, MOST))
    start_ns = solution.drive.stamp_ns[:1]
    return SensorRecord(
        use=use,
        timeline=timeline,
        fit=fit_figures(evidence, float(solution.drive.sensors.noise[index])),
        normalised=normalised_figures(evidence),
        series=series(curves(evidence, sensor), evidence, start_ns, most),
    )


def sensor_evidence(solution: DriveSolution, inside: IntArray) -> SensorEvidence:
    """Return one sensor's readings, by their rows, with predictions and residuals.

    Each has the time of its key pose.
    """
    drive, prediction = solution.drive, solution.prediction
    at, C = prediction.placed.readings, prediction.placed.C[inside]
    R, field, residual = at.R_map_lidar[inside], at.field[inside], prediction.residual[inside]
    H = drive.sensors.distortion[at.sensor[inside], 9:]
    b = np.asarray(np.linalg.solve(C, (residual + field - H)[:, :, None])[:, :, 0], dtype=float)
    W = prediction.whitening(drive.sensors.noise, extra=solution.interpolation_covariance)[inside]
    readings = Readings(
        sensors=drive.sensors.names,
        sensor=at.sensor[inside],
        stamp_ns=drive.stamp_ns[drive.readings.key_pose[inside]],
        R_map_lidar=R,
        p_map_lidar=at.p_map_lidar[inside],
        field=field,
    )
    return SensorEvidence(
        readings=readings,
        used=solution.used[inside],
        place=prediction.placed.x[inside],
        B_map=np.einsum("nij,nj->ni", R, b),
        b_lidar=b,
        residual=residual,
        map_share=map_covariance(C, R, prediction.map_variance[inside]),
        pose_share=solution.interpolation_covariance[inside],
        white=np.einsum("nij,nj->ni", W, residual),
    )


def _timeline(solution: DriveSolution, own: IntArray) -> Timeline:
    """Return how many readings of a sensor, by their rows, counted over time."""
    drive, prediction = solution.drive, solution.prediction
    at = 1e-9 * (drive.stamp_ns - drive.stamp_ns[0])
    edges = np.linspace(0.0, at[-1], min(SPANS, max(len(drive) // POSES, 1)) + 1)
    seconds, inside, used = (
        at[drive.readings.key_pose[own]],
        prediction.inside[own],
        solution.used[own],
    )

    def count(which: FloatArray) -> tuple[int, ...]:
        return tuple(np.histogram(which, edges)[0].tolist())

    return Timeline(
        edges=row(edges, 3),
        used=count(seconds[used]),
        rejected=count(seconds[inside & ~used]),
        outside=count(seconds[~inside]),
    )
