"""Drives localised in a map, or in the field that they meet, with scans beside odometry."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

from l2m_gtsam.batch.drives import METRICS_FILE
from l2m_gtsam.batch.files import SavedMap, check_not_replaced, check_outputs, map_notes
from l2m_gtsam.batch.maps import write_map
from l2m_gtsam.batch.reports import REPORT_FILE, SLAM_FILE, write_slam_report
from l2m_gtsam.batch.scan_poses import bag_scans, read_drive_or_follow, scan_start
from l2m_gtsam.batch.software import versions
from l2m_gtsam.config import Config
from l2m_gtsam.data import LidarMap, Recording, SourceFile
from l2m_gtsam.errors import LidarError, MapError, OutputError
from l2m_gtsam.geometry import compose
from l2m_gtsam.lidar.loop_closures import find_loop_closures
from l2m_gtsam.lidar.odometry import ScanStep
from l2m_gtsam.lidar.registration import PoseEstimate
from l2m_gtsam.lidar.scan_localisation import localise_scans, spaced
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import Progress, reported
from l2m_gtsam.qa.metrics.trajectory import check_truth
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.qa.verdict.localisation import judgement_of_localisation
from l2m_gtsam.recording.odometry_jumps import without_jumps
from l2m_gtsam.recording.sync import twists
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation import LocalisationResult, LocalisationStatus
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.records.scans import PoseFix, ScanEvidence
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.slam.exploration import explore, field_samples
from l2m_gtsam.slam.localisation import NO_SCANS, localise, start_pose
from l2m_gtsam.slam.odometry import scan_odometry
from l2m_gtsam.slam.options import Usage
from l2m_gtsam.slam.pose_graph import write_g2o
from l2m_gtsam.slam.record import RecordContext, localisation_record
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.files import atomic_path, source_file
from l2m_gtsam.storage.listed_sensors import read_sensors
from l2m_gtsam.storage.point_cloud2 import has_clouds
from l2m_gtsam.storage.pose_files import read_tum
from l2m_gtsam.storage.record_files import record_id, write_slam
from l2m_gtsam.storage.result_set import published
from l2m_gtsam.storage.trajectory_files import LocalisedMotion, write_trajectory_bag, write_tum


@dataclass(frozen=True)
class Scanned:
    """What scans say, and what is worth a warning."""

    evidence: ScanEvidence = NO_SCANS
    notes: tuple[str, ...] = ()


def read_evidence(
    bag: Path, recording: Recording, saved: SavedMap | None, config: Config, progress: Progress
) -> Scanned:
    """Register the scans of a bag: on the cloud of the map if it has one, else on each other.

    Scans that fit nowhere do not stop a localisation: it goes on without, and says so.

    Parameters
    ----------
    bag
        The drive.
    recording
        What was read of it: its poses are odometry.
    saved
        The map, if there is one.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    BagError
        The bag's clouds are not usable.
    """
    if config.slam.scans is Usage.IGNORED or not has_clouds(bag):
        return Scanned()
    mapped = None if saved is None else saved.state.lidar
    options = config.lidar.loops if mapped is None else config.lidar.localisation
    try:
        scans = bag_scans(bag, config, progress)
        repaired = without_jumps(recording.trajectory, config.slam.jumps)
        steps = scan_odometry(scans, repaired, options.registration.edge, config.slam)
        if mapped is None:
            loops = find_loop_closures(steps, config.lidar.loops)
            return Scanned(ScanEvidence(loops=loops))
        return Scanned(ScanEvidence(fixes=_fixes(steps, recording, mapped, config)))
    except LidarError as error:
        return Scanned(notes=(f"{bag}: its point clouds take no part: {error}",))


def _fixes(
    steps: Iterator[ScanStep], recording: Recording, mapped: LidarMap, config: Config
) -> tuple[PoseFix, ...]:
    first = next(steps, None)
    if first is None:
        raise LidarError("no scan has points enough, at a time that has odometry")
    cloud = Surface(mapped.points)
    if config.slam.start.anywhere:
        start = scan_start(first, cloud, mapped, config.lidar)
    else:
        known = start_pose(recording.trajectory, config.slam.start)
        T_map_odom = compose(known.T_map_lidar, recording.trajectory.pose(0).inverse())
        start = PoseEstimate(compose(T_map_odom, first.T_odom_lidar), known.covariance)
    options = config.lidar.localisation.beside_odometry()
    found = localise_scans(chain([first], steps), cloud, start, options)
    return spaced(found.fixes, config.slam.key_poses.distance_m, options)


TRAJECTORY_FILE = "trajectory.tum"
BAG_FILE = "trajectory.mcap"
GRAPH_FILE = "graph.g2o"
REFINED_FILE = "refined.yaml"
MAP_FILE = "map.npz"
FILES = (TRAJECTORY_FILE, BAG_FILE, GRAPH_FILE, SLAM_FILE, REFINED_FILE, MAP_FILE, REPORT_FILE)
REFINED = (
    "refined by `l2m slam`: the verdict is that of the calibration before, not of what it became"
)
NOWHERE = (LocalisationStatus.OUTSIDE_MAP, LocalisationStatus.NOT_HERE)


@dataclass(frozen=True)
class SlamInput:
    """Files of a localisation.

    Attributes
    ----------
    bag
        A drive with odometry and magnetic readings.
    map
        Map file; without one the field is found with the poses.
    calibration
        A `calibration.yaml` of its sensors.
    truth
        Poses of the lidar in the map (TUM), if they are known.
    """

    bag: Path
    map: Path | None
    calibration: Path
    truth: Path | None = None


@dataclass(frozen=True)
class SlamOutcome:
    """What was written of a localisation, and the verdict on it."""

    result: LocalisationResult
    record: LocalisationRecord
    verdict: Verdict


@dataclass(frozen=True)
class _Found:
    """A drive that was solved.

    Attributes
    ----------
    recording
        The drive.
    result, solution
        What came out, and of its graph.
    field_map
        That it was localised in, or that was made of what it met.
    """

    recording: Recording
    result: LocalisationResult
    solution: DriveSolution
    field_map: FieldMap


def slam_bag(given: SlamInput, config: Config, out: Path, progress: Progress) -> SlamOutcome:
    """Localise a drive; write trajectory, graph, figures and, if it is refined, the calibration.

    Without a map the field along the drive is written as one.

    Parameters
    ----------
    given
        What is read.
    out
        Folder for the results, made if it is missing.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then. A MapError if the
        drive turns out not to be in this map, or may have begun at several places of it.
    """
    _check_folder(out)
    saved = None if given.map is None else SavedMap.read(given.map)
    calibration = read_sensors(given.calibration)
    check_not_replaced(out / REFINED_FILE, given.calibration)
    truth = None if given.truth is None else read_tum(given.truth)
    recording = read_drive_or_follow(given.bag, config, progress)
    scanned = read_evidence(given.bag, recording, saved, config, progress)
    gap = config.slam.max_pose_gap_s
    if truth is not None:
        check_truth(truth, recording.trajectory, gap, str(given.truth))
    map_source = None if saved is None else source_file(saved.path)
    calibration_source = source_file(given.calibration)
    if saved is None:
        found = _explored(recording, calibration, scanned.evidence, config, progress)
    else:
        found = _localised(recording, calibration, saved, scanned.evidence, config, progress)
    used = calibration_notes(given.calibration, calibration)
    doubted = () if saved is None else map_notes(saved, found.field_map)
    notes = (*used, *doubted, *scanned.notes, *found.result.notes)
    result = replace(found.result, map=map_source, calibration_source=calibration_source)
    found = replace(found, result=replace(result, notes=notes))
    options = config.model_dump(mode="json", include={"bag", "lidar", "slam", "qa"})
    truth_source = None if given.truth is None else source_file(given.truth)
    context = RecordContext(calibration, found.field_map, options, gap, truth, truth_source)
    unjudged = localisation_record(found.result, found.solution, context)
    judgement = judgement_of_localisation(unjudged, config.qa)
    record = replace(unjudged, judgement=judgement, versions=versions())
    # A map that was read may be there from an exploration.
    names = [name for name in FILES if name != MAP_FILE or saved is None]
    with published(out, *names) as stage:
        _write(found, record, config, stage)
        if saved is None:
            frame = found.result.trajectory.frame
            of_map = map_provenance(recording, calibration, calibration_source, frame, config)
            write_map(stage / MAP_FILE, found.field_map, of_map, None)
        identity = Identity(record_id(stage / SLAM_FILE), source_file(stage / SLAM_FILE))
        write_slam_report(stage / REPORT_FILE, record, config.qa, identity)
    return SlamOutcome(found.result, record, judgement.verdict)


def calibration_notes(path: Path, calibration: CalibrationResult) -> tuple[str, ...]:
    """Return what whoever uses a calibration has to know of it, a sentence each."""
    # Notes of a calibration are its own; those of a list say what is assumed here.
    assumed = () if calibration.versions else calibration.notes
    if not _has_failed(calibration):
        return assumed
    return (*assumed, f"{path}: the verdict on the calibration that is used here is FAIL")


def map_provenance(
    recording: Recording,
    calibration: CalibrationResult,
    source: SourceFile,
    frame: str,
    config: Config,
) -> dict[str, Any]:
    """Return where a map comes from that is made of the field that a drive met.

    Parameters
    ----------
    recording
        The drive.
    calibration, source
        With what its readings were used, and the file of it.
    frame
        Of the map.
    config
        With what options.
    """
    level = {"verdict": Level.FAIL.value} if _has_failed(calibration) else {}
    return {
        "bags": [vars(recording.source)],
        "calibration": {**vars(source), **level},
        "frame": frame,
        "config": config.model_dump(mode="json", include={"bag", "slam", "mapping"}),
        "version": version("l2m-gtsam"),
    }


def _has_failed(calibration: CalibrationResult) -> bool:
    judged = calibration.judgement
    return judged is not None and judged.level is Level.FAIL


def opened(saved: SavedMap, recording: Recording, config: Config, progress: Progress) -> FieldMap:
    """Return the map that a drive is localised in."""
    # A start that is given, or found, puts odometry of any frame into the map.
    return saved.open(progress, [recording] if config.slam.start.by_odometry else [])


def _localised(
    recording: Recording,
    calibration: CalibrationResult,
    saved: SavedMap,
    evidence: ScanEvidence,
    config: Config,
    progress: Progress,
) -> _Found:
    field_map = opened(saved, recording, config, progress)
    found = localise(recording, field_map, calibration, config.slam, progress, evidence)
    if found.result.status in NOWHERE:
        reasons = "; ".join((found.result.message, *found.result.notes))
        raise MapError(f"{recording.source.path} in {saved.path}: {reasons}")
    return _Found(recording, found.result, found.solution, field_map)


def _explored(
    recording: Recording,
    calibration: CalibrationResult,
    evidence: ScanEvidence,
    config: Config,
    progress: Progress,
) -> _Found:
    found = explore(recording, calibration, config.slam, progress, evidence)
    with reported("building the map", progress):
        field_map = build_map(*field_samples(found.solution), config.mapping.model)
    return _Found(recording, found.result, found.solution, field_map)


def _check_folder(out: Path) -> None:
    """Raise an OutputError, before any work is done, if results cannot be written there."""
    check_outputs(*(out / name for name in FILES))
    if (out / METRICS_FILE).exists():
        raise OutputError(
            f"{out}: holds a calibration, whose report would be lost; choose another --out"
        )


def write_refined(out: Path, calibration: CalibrationResult) -> None:
    """Write a calibration as a drive refined it, with a note on its verdict."""
    notes = (*calibration.notes, REFINED)
    made = replace(calibration, bags=(), notes=notes, metrics_sha256="")
    write_calibration(out / REFINED_FILE, made)


def _write(found: _Found, record: LocalisationRecord, config: Config, out: Path) -> None:
    result, odometry = found.result, found.recording.trajectory
    write_tum(out / TRAJECTORY_FILE, result.trajectory)
    steady = without_jumps(odometry, config.slam.jumps).trajectory
    velocity = twists(steady, result.trajectory.stamp_ns)
    write_trajectory_bag(out / BAG_FILE, LocalisedMotion(result.trajectory, velocity, odometry))
    with atomic_path(out / GRAPH_FILE) as temporary:
        write_g2o(temporary, found.solution)
    if result.calibration is not None:
        made = replace(result.calibration, bag=result.bag, map=result.map, options=record.options)
        write_refined(out, made)
    write_slam(out / SLAM_FILE, record)
