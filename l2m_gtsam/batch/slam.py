"""Drives localised in a map: from files to files."""

from dataclasses import dataclass, replace
from pathlib import Path

from l2m_gtsam.batch.drives import METRICS_FILE
from l2m_gtsam.batch.opening import SavedMap
from l2m_gtsam.batch.outputs import check_outputs, ensure_folder
from l2m_gtsam.batch.reports import REPORT_FILE
from l2m_gtsam.batch.scan_poses import read_drive_or_follow
from l2m_gtsam.batch.slam_report import SLAM_FILE, write_slam_report
from l2m_gtsam.config import Config
from l2m_gtsam.data import Recording
from l2m_gtsam.errors import MapError, OutputError
from l2m_gtsam.graph.slam.g2o import write_g2o
from l2m_gtsam.localise import Localisation, Sources, localise
from l2m_gtsam.progress import Progress
from l2m_gtsam.qa.judge import Verdict
from l2m_gtsam.qa.slam.errors import check_truth
from l2m_gtsam.slam_figures import Told, localisation_record
from l2m_gtsam.slam_records import LocalisationRecord
from l2m_gtsam.slam_results import LocalisationResult, LocalisationStatus
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.digest import source_file
from l2m_gtsam.storage.slam_file import write_slam
from l2m_gtsam.storage.trajectory_bag import LocalisedMotion, write_trajectory_bag
from l2m_gtsam.storage.tum import read_tum, write_tum
from l2m_gtsam.sync import twists

TRAJECTORY_FILE = "trajectory.tum"
BAG_FILE = "trajectory.mcap"
GRAPH_FILE = "graph.g2o"
REFINED_FILE = "refined.yaml"
FILES = (TRAJECTORY_FILE, BAG_FILE, GRAPH_FILE, SLAM_FILE, REFINED_FILE, REPORT_FILE)
NOWHERE = (LocalisationStatus.OUTSIDE_MAP, LocalisationStatus.NOT_HERE)


@dataclass(frozen=True)
class SlamInput:
    """Files of a localisation.

    Attributes
    ----------
    bag
        A drive with odometry and magnetic readings.
    map
        Map file.
    calibration
        A `calibration.yaml` of its sensors.
    truth
        Poses of the lidar in the map (TUM), if they are known.
    """

    bag: Path
    map: Path
    calibration: Path
    truth: Path | None = None


@dataclass(frozen=True)
class SlamOutcome:
    """What was written of a localisation, and the verdict on it."""

    result: LocalisationResult
    record: LocalisationRecord
    verdict: Verdict


@dataclass(frozen=True)
class _Made:
    """A localisation with what it was made from and what is kept of it."""

    recording: Recording
    found: Localisation
    record: LocalisationRecord


def slam_bag(given: SlamInput, config: Config, out: Path, progress: Progress) -> SlamOutcome:
    """Localise a drive; write trajectory, graph, figures and, if it is refined, the calibration.

    Parameters
    ----------
    given
        What is read.
    config
        Configuration.
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
    saved, calibration = SavedMap.read(given.map), read_calibration(given.calibration)
    if (out / REFINED_FILE).exists() and given.calibration.samefile(out / REFINED_FILE):
        raise OutputError(f"{given.calibration}: is what is read; choose another --out")
    truth = None if given.truth is None else read_tum(given.truth)
    recording = read_drive_or_follow(given.bag, config, progress)
    gap = config.slam.max_pose_gap_s
    if truth is not None:
        check_truth(truth, recording.trajectory, gap, str(given.truth))
    start = config.slam.start
    # A start that is given, or found, puts odometry of any frame into the map.
    is_given = start.position is not None and start.quaternion_xyzw is not None
    anywhere = start.anywhere or is_given
    field_map = saved.open(progress, [] if anywhere else [recording])
    sources = Sources(source_file(given.map), source_file(given.calibration))
    found = localise(recording, field_map, calibration, config.slam, progress, sources)
    if found.result.status in NOWHERE:
        raise MapError(f"{given.bag} in {given.map}: {found.result.message}")
    options = config.model_dump(mode="json", include={"bag", "slam", "qa"})
    truth_source = None if given.truth is None else source_file(given.truth)
    told = Told(calibration, field_map, options, gap, truth, truth_source)
    made = _Made(recording, found, localisation_record(found.result, found.solution, told))
    ensure_folder(out)
    _write(made, out)
    verdict = write_slam_report(out / REPORT_FILE, made.record, config.qa)
    return SlamOutcome(found.result, made.record, verdict)


def _check_folder(out: Path) -> None:
    """Raise an OutputError, before any work is done, if results cannot be written there."""
    check_outputs(*(out / name for name in FILES))
    if (out / METRICS_FILE).exists():
        raise OutputError(
            f"{out}: holds a calibration, whose report would be lost; choose another --out"
        )


def _write(made: _Made, out: Path) -> None:
    result, odometry = made.found.result, made.recording.trajectory
    write_tum(out / TRAJECTORY_FILE, result.trajectory)
    velocity = twists(odometry, result.trajectory.stamp_ns)
    write_trajectory_bag(out / BAG_FILE, LocalisedMotion(result.trajectory, velocity, odometry))
    with atomic_path(out / GRAPH_FILE) as temporary:
        write_g2o(temporary, made.found.solution)
    (out / REFINED_FILE).unlink(missing_ok=True)  # of an earlier run, which these files replace
    if result.calibration is not None:
        refined = replace(
            result.calibration,
            bag=result.bag,
            bags=(),
            map=result.map,
            options=made.record.options,
        )
        write_calibration(out / REFINED_FILE, refined)
    write_slam(out / SLAM_FILE, made.record)
