"""Drives localised in a map: from files to files."""

from dataclasses import dataclass, replace
from pathlib import Path

from l2m_gtsam.batch.opening import SavedMap
from l2m_gtsam.batch.outputs import check_outputs, ensure_folder
from l2m_gtsam.batch.scan_poses import read_drive_or_follow
from l2m_gtsam.config import Config
from l2m_gtsam.errors import MapError, OutputError
from l2m_gtsam.graph.slam.g2o import write_g2o
from l2m_gtsam.localise import Localisation, Sources, localise
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam_results import LocalisationResult, LocalisationStatus
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.digest import source_file
from l2m_gtsam.storage.slam_file import write_slam
from l2m_gtsam.storage.tum import write_tum

TRAJECTORY_FILE = "trajectory.tum"
GRAPH_FILE = "graph.g2o"
SLAM_FILE = "slam.json"
REFINED_FILE = "refined.yaml"
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
    """

    bag: Path
    map: Path
    calibration: Path


def slam_bag(given: SlamInput, config: Config, out: Path, progress: Progress) -> LocalisationResult:
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
        drive turns out not to be in this map.
    """
    files = [out / name for name in (TRAJECTORY_FILE, GRAPH_FILE, SLAM_FILE, REFINED_FILE)]
    check_outputs(*files)
    saved, calibration = SavedMap.read(given.map), read_calibration(given.calibration)
    if (out / REFINED_FILE).exists() and given.calibration.samefile(out / REFINED_FILE):
        raise OutputError(f"{given.calibration}: is what is read; choose another --out")
    recording = read_drive_or_follow(given.bag, config, progress)
    start = config.slam.start
    # A start that is given puts odometry of any frame into the map.
    anywhere = start.position is not None and start.quaternion_xyzw is not None
    field_map = saved.open(progress, [] if anywhere else [recording])
    sources = Sources(source_file(given.map), source_file(given.calibration))
    found = localise(recording, field_map, calibration, config.slam, progress, sources)
    if found.result.status in NOWHERE:
        raise MapError(f"{given.bag} in {given.map}: {found.result.message}")
    ensure_folder(out)
    _write(found, config, out)
    return found.result


def _write(found: Localisation, config: Config, out: Path) -> None:
    result = found.result
    write_tum(out / TRAJECTORY_FILE, result.trajectory)
    with atomic_path(out / GRAPH_FILE) as temporary:
        write_g2o(temporary, found.solution)
    options = config.model_dump(mode="json", include={"bag", "slam"})
    (out / REFINED_FILE).unlink(missing_ok=True)  # of an earlier run, which these files replace
    if result.calibration is not None:
        refined = replace(
            result.calibration, bag=result.bag, bags=(), map=result.map, options=options
        )
        write_calibration(out / REFINED_FILE, refined)
    write_slam(out / SLAM_FILE, result, options)
