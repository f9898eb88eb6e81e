"""A fleet: all drives of all vehicles, going on where it was stopped."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from l2m_gtsam.batch.files import SavedMap, check_outputs
from l2m_gtsam.batch.fleet_task import (
    CSV_FILE,
    PAGE_FILE,
    PARQUET_FILE,
    RESULTS,
    FleetDrive,
    FleetOrder,
    FleetTask,
    calibrated_drive,
    digest_of,
    fleet_drives,
    lost_drive,
    map_of,
    open_map,
)
from l2m_gtsam.batch.reports import OUTCOME_FILE
from l2m_gtsam.config import Config, load_config, with_poses
from l2m_gtsam.errors import L2MError
from l2m_gtsam.parallel.cluster import ClusterOptions, Work, computed
from l2m_gtsam.progress import Count, Progress, counter
from l2m_gtsam.qa.fleet import with_outliers
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.qa.report.fleet_page import fleet_page
from l2m_gtsam.records.fleet import DriveOutcome, FleetRow
from l2m_gtsam.records.verdict import Level, worst
from l2m_gtsam.storage.files import printable, source_file, write_text
from l2m_gtsam.storage.fleet_table import write_csv, write_parquet
from l2m_gtsam.storage.parts import only_one
from l2m_gtsam.storage.record_files import read_outcome
from l2m_gtsam.storage.result_set import made, published

COUNTS = {"bag", "calibration", "qa"}  # parts of a configuration that a drive's results depend on
WORK = Work(map_of, open_map, calibrated_drive, lost_drive)


@dataclass(frozen=True)
class Fleet:
    """What became of a fleet.

    Attributes
    ----------
    rows
        In order of vehicle, date, bag and sensor.
    drives
        How many there are.
    computed
        How many of them were computed now; the others were there.
    notes
        What could not be written, and how it could be.
    """

    rows: tuple[FleetRow, ...]
    drives: int
    computed: int
    notes: tuple[str, ...]

    @property
    def level(self) -> Level:
        """The worst verdict of all sensors; FAIL if a drive was not calibrated."""
        sensors = [row.sensor for row in self.rows]
        return worst(Level.FAIL if each is None else Level(each.verdict) for each in sensors)


def run_fleet(order: FleetOrder, cluster: ClusterOptions, progress: Progress) -> Fleet:
    """Calibrate all drives of a fleet that are not there yet; write page and tables of all.

    A drive that fails is a row with its reason. What is there from an earlier run is taken over
    where bag, map, configuration (`config_digest`) and the program's version are the same.

    Parameters
    ----------
    order
        What is wanted.
    cluster
        Who computes; all must see the same files.
    progress
        Called with the stage "fleet" and the share of drives that are done.

    Raises
    ------
    L2MError
        Folder or manifest, a map or a configuration cannot be used, nothing can be written, or
        there is no cluster. Page and tables stay as they were; drives that are done are kept.
    """
    out = order.out.absolute()
    drives = fleet_drives(order)
    check_outputs(*(out / name for name in (PAGE_FILE, CSV_FILE, PARQUET_FILE)))
    fleet_options = load_config(order.config).fleet
    tasks = fleet_tasks(drives, out)
    with made(out), only_one(out):
        return _computed(tasks, out, fleet_options, cluster, counter("fleet", progress))


def _computed(
    tasks: Sequence[FleetTask],
    out: Path,
    options: FleetOptions,
    cluster: ClusterOptions,
    count: Count,
) -> Fleet:
    """Compute what is missing; write page and tables of all drives."""
    outcomes: dict[str, DriveOutcome] = {}
    for task in tasks:
        if (there := _there(task)) is not None:
            outcomes[task.drive.folder] = there
            count(len(outcomes), len(tasks))
    missing = [task for task in tasks if task.drive.folder not in outcomes]
    for task, outcome in computed(WORK, missing, cluster):
        outcomes[task.drive.folder] = outcome
        count(len(outcomes), len(tasks))
    once = counted_once({task.drive.folder: outcomes[task.drive.folder] for task in tasks})
    rows = [row for task in tasks for row in _rows(task.drive, once[task.drive.folder])]
    marked = with_outliers(sorted(rows, key=_order), options)
    return Fleet(marked, len(tasks), len(missing), _publish(out, marked, options))


def fleet_tasks(listed: Sequence[FleetDrive], out: Path) -> list[FleetTask]:
    """Return what is to be done, drives of one map together; an L2MError if that cannot begin.

    Maps and configurations are read here once: what is wrong with them concerns many drives.
    """
    drives = [_absolute(drive) for drive in listed]
    maps = {path: _map_digest(path) for path in dict.fromkeys(each.map_path for each in drives)}
    configs = {path: load_config(path) for path in dict.fromkeys(each.config for each in drives)}
    digests = {path: config_digest(config) for path, config in configs.items()}
    tasks = [
        FleetTask(
            drive,
            (config := _with_poses(configs[drive.config], drive)),
            out / drive.folder,
            maps[drive.map_path],
            _with_pose_files(digests[drive.config], config, drive),
        )
        for drive in drives
    ]
    places = list(maps)
    return sorted(tasks, key=lambda each: places.index(each.drive.map_path))


def _absolute(drive: FleetDrive) -> FleetDrive:
    """Return a drive that workers in other folders find."""
    return replace(
        drive,
        bag=drive.bag.absolute(),
        map_path=drive.map_path.absolute(),
        poses=drive.poses and drive.poses.absolute(),
        pose_times=drive.pose_times and drive.pose_times.absolute(),
    )


def _with_poses(config: Config, drive: FleetDrive) -> Config:
    """Return the configuration of a drive with the poses that the manifest names."""
    poses = [] if drive.poses is None else [drive.poses]
    return with_poses(config, [drive.bag], poses, drive.pose_times)


def _with_pose_files(digest: str, config: Config, drive: FleetDrive) -> str:
    """Return the digest of a configuration and of what files with a drive's poses hold."""
    options = config.bag.pose_file
    files = [path for path in (options.of(drive.bag), options.times) if path is not None]
    if not files:
        return digest
    return hashlib.sha256("".join([digest, *map(digest_of, files)]).encode()).hexdigest()


def _map_digest(path: Path) -> str:
    """Return the digest of a map; a MapError if it is missing or damaged."""
    SavedMap.read(path)
    return source_file(path).sha256


def config_digest(config: Config) -> str:
    """Return the digest of what a calibration and its verdict depend on.

    Not of how maps are built, drives planned or localised, or the fleet shown.
    """
    content = json.dumps(config.model_dump(mode="json", include=COUNTS), sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


def _there(task: FleetTask) -> DriveOutcome | None:
    """Return the outcome of an earlier run if it would be the same now."""
    found = read_outcome(task.out / OUTCOME_FILE)
    if found is None or not found.lasting or found.key != task.key(found.key.bag):
        return None
    if not found.error and not all((task.out / name).is_file() for name in RESULTS):
        return None
    try:
        return found if source_file(task.drive.bag).sha256 == found.key.bag else None
    except L2MError:
        return None


def counted_once(outcomes: Mapping[str, DriveOutcome]) -> dict[str, DriveOutcome]:
    """Return outcomes in which a recording that has several names counts under the first.

    Twice it would make a vehicle seem to repeat.

    Parameters
    ----------
    outcomes
        Of drives by their folders.
    """
    first: dict[tuple[str, str, str], str] = {}
    once = dict(outcomes)
    for folder, outcome in outcomes.items():
        same = outcome.key.bag, outcome.key.map, outcome.key.config
        if outcome.error or first.setdefault(same, folder) == folder:
            continue
        error = f"it is the same recording as {first[same]}, which counts; leave one of them out"
        once[folder] = replace(outcome, sensors=(), error=error)
    return once


def _rows(drive: FleetDrive, outcome: DriveOutcome) -> list[FleetRow]:
    """Return the rows of a drive: one for each sensor, or one that says why there are none."""
    vehicle, bag = printable(drive.vehicle), printable(drive.bag.name)
    date, duration = drive.date or outcome.start, outcome.duration
    return [
        FleetRow(vehicle, bag, drive.folder, date, duration, sensor, outcome.error)
        for sensor in outcome.sensors or (None,)
    ]


def _publish(out: Path, rows: Sequence[FleetRow], options: FleetOptions) -> tuple[str, ...]:
    """Write page and tables; return what could not be written, a sentence each."""
    with published(out, PAGE_FILE, CSV_FILE, PARQUET_FILE) as stage:
        write_csv(stage / CSV_FILE, rows)
        notes = write_parquet(stage / PARQUET_FILE, rows)
        write_text(stage / PAGE_FILE, fleet_page(rows, options))
    return notes


def _order(row: FleetRow) -> tuple[str, str, str, str]:
    return (row.vehicle, row.date, row.folder, "" if row.sensor is None else row.sensor.sensor)
