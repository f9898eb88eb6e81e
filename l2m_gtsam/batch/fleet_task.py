"""The drives of a fleet, and one of them on whichever worker: it always ends as an outcome."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

from l2m_gtsam.batch.drives import CALIBRATION_FILE, METRICS_FILE, OVERVIEW_FILE, calibrate_drive
from l2m_gtsam.batch.files import OpenMap, SavedMap, check_outputs
from l2m_gtsam.batch.reports import (
    OUTCOME_FILE,
    PDF_FILE,
    REPORT_FILE,
    calibration_results,
    report_calibration,
)
from l2m_gtsam.batch.scan_poses import read_drive_on
from l2m_gtsam.config import Config
from l2m_gtsam.errors import BagError, ConfigError, L2MError, NoRoomError, OutputError
from l2m_gtsam.progress import silent
from l2m_gtsam.qa.fleet import sensor_rows
from l2m_gtsam.records.fleet import DATE, Computation, DriveOutcome, RowKey
from l2m_gtsam.records.provenance import in_utc
from l2m_gtsam.storage.drive_lists import ManifestEntry, find_bags, is_bag, is_folder, read_manifest
from l2m_gtsam.storage.files import folder_names, printable, source_file, unwritten
from l2m_gtsam.storage.log import DRIVES
from l2m_gtsam.storage.parts import sweep
from l2m_gtsam.storage.record_files import write_outcome
from l2m_gtsam.storage.result_set import SET_FILE, finish, published

PAGE_FILE, CSV_FILE, PARQUET_FILE = "index.html", "fleet.csv", "fleet.parquet"


@dataclass(frozen=True)
class FleetOrder:
    """What is wanted of a fleet.

    Attributes
    ----------
    source
        Folder or manifest.
    map_path, config
        Map and configuration of drives that a manifest gives none.
    out
        Folder for the results.
    """

    source: Path
    map_path: Path | None
    config: Path | None
    out: Path


@dataclass(frozen=True)
class FleetDrive:
    """A drive, and where its results go.

    Attributes
    ----------
    bag, map_path, config
        Files; no configuration for defaults.
    vehicle
        Name.
    listed
        What identifies it, wherever all drives are moved to: paths as seen from the folder or the
        manifest.
    date
        When it was, UTC, ISO 8601, where the stamps are not to be asked; else empty.
    folder
        For the results, relative to that of the fleet, with slashes.
    poses, pose_times
        Files with its poses, and with their times, where they are not in the bag.
    """

    bag: Path
    map_path: Path
    config: Path | None
    vehicle: str
    listed: str
    date: str = ""
    folder: str = ""
    poses: Path | None = None
    pose_times: Path | None = None

    @property
    def name(self) -> str:
        """The bag's name for its folder."""
        return self.bag.stem if self.bag.suffix.lower() in DRIVES else self.bag.name


def fleet_drives(order: FleetOrder) -> tuple[FleetDrive, ...]:
    """Return the drives of a fleet; whether their bags can be read is seen later.

    Raises
    ------
    BagError
        There are none, or a folder cannot be read.
    ConfigError
        The manifest is not one, a drive has no map, or is listed twice.
    """
    if is_folder(order.source):
        return _with_folders(_in_folder(order))
    if is_bag(order.source):
        raise BagError(
            f"{order.source}: is a bag; accepted: a folder of bags or a manifest, or `l2m "
            "calibrate` for one bag"
        )
    return _with_folders([_listed(order, each) for each in read_manifest(order.source)])


def _in_folder(order: FleetOrder) -> list[FleetDrive]:
    bags = find_bags(order.source, order.out)
    if not bags:
        raise BagError(
            f"{order.source}: no bags in it; accepted: ROS1 .bag, .mcap, .db3, .ulg, ROS2 folders"
        )
    if order.map_path is None:
        raise ConfigError(f"{order.source}: a folder of bags needs a map; give it with --map")
    return [
        FleetDrive(bag, order.map_path, order.config, _vehicle(bag), _seen_from(order.source, bag))
        for bag in bags
    ]


def _vehicle(bag: Path) -> str:
    """Return the name of the folder that a bag lies in: of a link, not of what it points to."""
    here = bag if bag.name not in ("", "..") else bag.resolve()
    return here.parent.resolve().name or "vehicle"


def _listed(order: FleetOrder, entry: ManifestEntry) -> FleetDrive:
    map_path = entry.map or order.map_path
    if map_path is None:
        raise ConfigError(
            f"{order.source}: {entry.bag.name} has no map; give it as `map`, or one for all with "
            "--map"
        )
    date = "" if entry.date is None else entry.date.strftime(DATE)
    folder = order.source.parent
    listed = "\0".join(
        _seen_from(folder, path)
        for path in (entry.bag, entry.map, entry.config, entry.poses)
        if path
    )
    config = entry.config or order.config
    return FleetDrive(
        entry.bag,
        map_path,
        config,
        entry.vehicle,
        listed,
        date,
        poses=entry.poses,
        pose_times=entry.pose_times,
    )


def _seen_from(folder: Path, path: Path) -> str:
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


def _with_folders(drives: Sequence[FleetDrive]) -> tuple[FleetDrive, ...]:
    """Return drives with a folder each."""
    vehicles: dict[str, list[FleetDrive]] = {}
    for drive in drives:
        vehicles.setdefault(drive.vehicle, []).append(drive)
    reserved = (PAGE_FILE, CSV_FILE, PARQUET_FILE)
    folders = folder_names(list(vehicles), list(vehicles), reserved)
    placed: list[FleetDrive] = []
    for (vehicle, own), folder in zip(vehicles.items(), folders, strict=True):
        identities = [each.listed for each in own]
        times = Counter(identities)
        if twice := [each for each in own if times[each.listed] > 1]:
            raise ConfigError(f"{twice[0].bag}: listed twice for vehicle {vehicle!r}; remove one")
        names = folder_names([each.name for each in own], identities)
        placed += [
            replace(each, folder=f"{folder}/{name}") for each, name in zip(own, names, strict=True)
        ]
    return tuple(placed)


RESULTS = (CALIBRATION_FILE, METRICS_FILE, OVERVIEW_FILE, REPORT_FILE)
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class FleetTask:
    """A drive to be calibrated.

    Attributes
    ----------
    out
        Folder for its results.
    map_digest, config_digest
        Of what it is calibrated with; see `RowKey`.
    """

    drive: FleetDrive
    config: Config
    out: Path
    map_digest: str
    config_digest: str

    def key(self, bag_digest: str) -> RowKey:
        """Return what the outcome depends on."""
        return RowKey(bag_digest, self.map_digest, self.config_digest, version("l2m-gtsam"))


def map_of(task: FleetTask) -> Path:
    """Return which map a drive needs."""
    return task.drive.map_path


def open_map(path: Path) -> OpenMap | str:
    """Open a map, once for all drives on it; what prevents that is the reason of their rows."""
    try:
        return OpenMap.of(SavedMap.read(path), silent)
    except L2MError as error:
        return str(error)
    except Exception as error:  # one map is not the end of drives on others
        return _unexpected(path, error)


def calibrated_drive(task: FleetTask, shared: OpenMap | str) -> DriveOutcome:
    """Calibrate a drive; publish what `l2m calibrate` writes and `outcome.json`, or that alone.

    Raises
    ------
    NoRoomError
        The results cannot be written, as those of other drives could not; the old ones stay.
    """
    begun = perf_counter()
    try:
        return _outcome(task, shared, begun)
    except NoRoomError:
        raise
    except OutputError as error:
        return _failed(task, str(error), begun)


def lost_drive(task: FleetTask, reason: str) -> DriveOutcome:
    """Return the outcome of a drive whose workers died."""
    return _failed(task, f"{task.drive.bag}: {reason}", perf_counter())


def _outcome(task: FleetTask, shared: OpenMap | str, begun: float) -> DriveOutcome:
    """Return what became of a drive; an OutputError if its results cannot be written."""
    check_outputs(*_files(task.out))
    try:
        if isinstance(shared, OpenMap):
            return _calibrated(task, shared, begun)
        outcome = _failed(task, shared, begun)
    except OutputError:
        raise
    except L2MError as error:
        outcome = _failed(task, str(error), begun, digest_of(task.drive.bag))
    except Exception as error:  # one drive is not the end of all others
        outcome = _failed(task, _unexpected(task.drive.bag, error), begun)
    _replace(task.out, outcome)
    return outcome


def _calibrated(task: FleetTask, opened: OpenMap, begun: float) -> DriveOutcome:
    recording = read_drive_on(opened.saved, task.drive.bag, task.config, silent)
    opened.saved.check_frame(recording)
    stamps = recording.trajectory.stamp_ns
    with calibration_results(task.out) as stage:
        found = calibrate_drive(recording, opened, task.config, stage, silent)
        verdict = report_calibration(stage, found, task.config.qa)
        outcome = DriveOutcome(
            key=task.key(recording.source.sha256),
            start=in_utc(int(stamps[0])),
            duration=round(float(stamps[-1] - stamps[0]) / NANOSECONDS, 3),
            sensors=sensor_rows(found.result, verdict),
            error="",
            lasting=True,
            made=_made(begun),
        )
        write_outcome(stage / OUTCOME_FILE, outcome)
    _sweep(task.out)
    return outcome


def _failed(task: FleetTask, reason: str, begun: float, digest: str = "") -> DriveOutcome:
    """Return the outcome of a drive that was not calibrated; lasting if its bag is to blame."""
    key = task.key(digest)
    return DriveOutcome(key, "", 0.0, (), printable(reason), bool(digest), _made(begun))


def _unexpected(path: Path, error: Exception) -> str:
    """Return the reason of a row for what was caused by a file, and should not have happened."""
    text = " ".join(str(error).split())[:300]
    return f"{path}: unexpected {type(error).__name__}: {text}; `l2m --debug calibrate` shows where"


def _replace(folder: Path, outcome: DriveOutcome) -> None:
    """Put an outcome in the place of results of an earlier bag, map or configuration.

    They must not pass for new ones. Of an outcome that may be another tomorrow nothing is kept.
    """
    names = [each.name for each in _files(folder)]
    if outcome.lasting:
        with published(folder, *names, unlisted=(OUTCOME_FILE,)) as stage:
            write_outcome(stage / OUTCOME_FILE, outcome)
    elif folder.is_dir():
        try:
            finish(folder)
            for name in names:
                (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise unwritten(folder, error) from error
    _sweep(folder)


def _sweep(folder: Path) -> None:
    """Remove what runs that were killed left hidden."""
    for each in _files(folder):
        sweep(each)


def _files(folder: Path) -> list[Path]:
    """Return what may be in the folder of a drive."""
    return [folder / name for name in (OUTCOME_FILE, *RESULTS, PDF_FILE, SET_FILE)]


def digest_of(path: Path) -> str:
    """Return the digest of a file; empty where it cannot be read now, but may be later."""
    try:
        return source_file(path).sha256
    except L2MError:
        return ""


def _made(begun: float) -> Computation:
    now = datetime.now(UTC).strftime(DATE)
    return Computation(now, round(perf_counter() - begun, 3))
