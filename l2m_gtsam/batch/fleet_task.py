"""One drive of a fleet on whichever worker: whatever happens, it ends as an outcome."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

from l2m_gtsam.batch.drives import (
    CALIBRATION_FILE,
    METRICS_FILE,
    OVERVIEW_FILE,
    calibrate_drive,
)
from l2m_gtsam.batch.fleet_drives import FleetDrive
from l2m_gtsam.batch.opening import OpenMap, SavedMap
from l2m_gtsam.batch.outputs import check_outputs, ensure_folder
from l2m_gtsam.batch.reports import PDF_FILE, REPORT_FILE, report_calibration
from l2m_gtsam.batch.scan_poses import read_drive_on
from l2m_gtsam.config import Config
from l2m_gtsam.data import Recording
from l2m_gtsam.errors import L2MError, OutputError
from l2m_gtsam.fleet_results import DATE, DriveOutcome, Made, RowKey
from l2m_gtsam.qa.fleet.rows import sensor_rows
from l2m_gtsam.storage.digest import source_file
from l2m_gtsam.storage.folder_names import printable
from l2m_gtsam.storage.outcome_file import write_outcome

OUTCOME_FILE = "outcome.json"
RESULTS = (CALIBRATION_FILE, METRICS_FILE, OVERVIEW_FILE, REPORT_FILE)
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class FleetTask:
    """A drive to be calibrated.

    Attributes
    ----------
    drive
        The drive.
    config
        Configuration.
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


@dataclass(frozen=True)
class FleetMap:
    """A map that several drives share.

    Attributes
    ----------
    opened
        The map; absent where it cannot be opened.
    saved
        What its file says of it, without its arrays.
    error
        Why it cannot be opened.
    """

    opened: OpenMap | None
    saved: SavedMap | None
    error: str = ""


def map_of(task: FleetTask) -> Path:
    """Return which map a drive needs."""
    return task.drive.map_path


def open_map(path: Path) -> FleetMap:
    """Open a map, once for all drives on it; whatever happens is the reason of their rows."""
    try:
        saved = SavedMap.read(path)
        opened = OpenMap(saved.open(_quiet), source_file(path))
        return FleetMap(opened, SavedMap(path, replace(saved.state, arrays={})))
    except L2MError as error:
        return FleetMap(None, None, str(error))
    except Exception as error:  # one map is not the end of drives on others
        return FleetMap(None, None, _unexpected(path, error))


def calibrated_drive(task: FleetTask, shared: FleetMap) -> DriveOutcome:
    """Calibrate a drive; write what `l2m calibrate` writes, and `outcome.json` at the very end."""
    begun = perf_counter()
    try:
        outcome = _outcome(task, shared, begun)
        if outcome.lasting:
            ensure_folder(task.out)
            write_outcome(task.out / OUTCOME_FILE, outcome)
    except OutputError as error:
        return _failed(task, str(error), begun)
    return outcome


def lost_drive(task: FleetTask, reason: str) -> DriveOutcome:
    """Return the outcome of a drive whose workers died."""
    return _failed(task, f"{task.drive.bag}: {reason}", perf_counter())


def _outcome(task: FleetTask, shared: FleetMap, begun: float) -> DriveOutcome:
    """Return what became of a drive; an OutputError if its results cannot be written."""
    _clear(task.out)
    try:
        if shared.opened is None or shared.saved is None:
            return _failed(task, shared.error, begun)
        return _calibrated(task, shared.opened, shared.saved, begun)
    except OutputError:
        raise
    except L2MError as error:
        digest = _digest(task.drive.bag)
        return _failed(task, str(error), begun, digest)
    except Exception as error:  # one drive is not the end of all others
        return _failed(task, _unexpected(task.drive.bag, error), begun)


def _calibrated(task: FleetTask, opened: OpenMap, saved: SavedMap, begun: float) -> DriveOutcome:
    recording = read_drive_on(saved, task.drive.bag, task.config, _quiet)
    saved.check_frame(recording)
    found = calibrate_drive(recording, opened, task.config, task.out, _quiet)
    verdict = report_calibration(task.out, found, task.config.qa)
    return DriveOutcome(
        key=task.key(recording.source.sha256),
        start=_start(recording),
        duration=_duration(recording),
        sensors=sensor_rows(found.result, verdict),
        error="",
        lasting=True,
        made=_made(begun),
    )


def _failed(task: FleetTask, reason: str, begun: float, digest: str = "") -> DriveOutcome:
    """Return the outcome of a drive that was not calibrated; lasting if its bag is to blame."""
    key = task.key(digest)
    return DriveOutcome(key, "", 0.0, (), printable(reason), bool(digest), _made(begun))


def _unexpected(path: Path, error: Exception) -> str:
    """Return the reason of a row for what was caused by a file, and should not have happened."""
    told = " ".join(str(error).split())[:300]
    return f"{path}: unexpected {type(error).__name__}: {told}; `l2m --debug calibrate` shows where"


def _clear(folder: Path) -> None:
    """Remove results of an earlier bag, map or configuration: they must not pass for new ones."""
    files = [folder / name for name in (OUTCOME_FILE, *RESULTS, PDF_FILE)]
    check_outputs(*files)
    try:
        # What a killed run was about to write has a name of its own.
        for file in [*files, *folder.glob(".*.part")]:
            file.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error


def _digest(bag: Path) -> str:
    """Return the digest of a bag; empty where it cannot be read now, but may be later."""
    try:
        return source_file(bag).sha256
    except L2MError:
        return ""


def _start(recording: Recording) -> str:
    seconds = int(recording.trajectory.stamp_ns[0]) // NANOSECONDS
    return datetime.fromtimestamp(seconds, UTC).strftime(DATE)


def _duration(recording: Recording) -> float:
    stamps = recording.trajectory.stamp_ns
    return round(float(stamps[-1] - stamps[0]) / NANOSECONDS, 3)


def _made(begun: float) -> Made:
    now = datetime.now(UTC).strftime(DATE)
    return Made(now, round(perf_counter() - begun, 3))


def _quiet(stage: str, fraction: float) -> None:
    """Tell nobody: workers have no terminal."""
