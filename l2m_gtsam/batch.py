"""Files in, files out: what the command line does, callable from Python."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from l2m_gtsam.calibrate import calibrate
from l2m_gtsam.config import Config
from l2m_gtsam.data import CalibrationResult, MapState, Recording
from l2m_gtsam.errors import MapError, OutputError
from l2m_gtsam.mapping import map_recordings
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.qa.figures import calibration_figure, map_figure, save_figure
from l2m_gtsam.qa.tables import MapDescription
from l2m_gtsam.simulate.bag_writer import BagKind, BagOptions, write_bag
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.storage.bag import read_recording
from l2m_gtsam.storage.calibration_file import (
    read_known_sensors,
    write_calibration,
    write_known_sensors,
)
from l2m_gtsam.storage.digest import source_file
from l2m_gtsam.storage.inspect import BagReport, inspect_bag
from l2m_gtsam.storage.map_file import load_map, save_map

Progress = Callable[[str, float], None]

CALIBRATION_FILE = "calibration.yaml"
OVERVIEW_FILE = "overview.png"


@dataclass(frozen=True)
class BuiltMap:
    """A map and what its file says of it."""

    field_map: FieldMap
    description: MapDescription


def build_map_file(
    bags: Sequence[Path], out: Path, config: Config, suite: Path | None, progress: Progress
) -> BuiltMap:
    """Build a map from mapping bags and write it.

    Parameters
    ----------
    bags
        One or several mapping bags.
    out
        Map file to write (`.npz`).
    config
        Configuration.
    suite
        File with the mapping suite's calibrations; ideal sensors at the lidar's origin if absent.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    _check_outputs(out, suffix=".npz")
    known = None if suite is None else read_known_sensors(suite)
    recordings = [_read(bag, config, progress) for bag in bags]
    progress("building the map", 0.0)
    field_map = map_recordings(recordings, known, config.mapping)
    progress("building the map", 1.0)
    state = field_map.to_state()
    provenance = {
        "bags": [vars(recording.source) for recording in recordings],
        "suite": None if suite is None else vars(source_file(suite)),
        "frame": recordings[0].trajectory.frame,
        "config": config.model_dump(mode="json", include={"bag", "mapping"}),
        "version": version("l2m-gtsam"),
    }
    _ensure_folder(out.parent)
    state = replace(state, provenance={**state.provenance, **provenance})
    save_map(out, state)
    return BuiltMap(field_map, MapDescription(field_map.summary, state.provenance))


def map_of(state: MapState, progress: Progress) -> FieldMap:
    """Return the map that a file holds, ready to be asked."""
    progress("loading the map", 0.0)
    field_map = map_from_state(state)
    progress("loading the map", 1.0)
    return field_map


def describe_map_file(path: Path, progress: Progress) -> MapDescription:
    """Return what a map file holds and where it came from."""
    state = load_map(path)
    return MapDescription(map_of(state, progress).summary, state.provenance)


def plot_map_file(path: Path, out: Path, height: float | None, progress: Progress) -> None:
    """Draw a map at a height in metres (the middle of its readings if None) as a picture."""
    _check_outputs(out, suffix=".png")
    field_map = map_of(load_map(path), progress)
    _ensure_folder(out.parent)
    save_figure(map_figure(field_map, height), out)


def inspect_file(bag: Path, config: Config, progress: Progress) -> BagReport:
    """Return what is in a bag and what would be used of it."""
    return inspect_bag(bag, config.bag, _counter(f"reading {bag.name}", progress))


def calibrate_bag(
    bag: Path, map_path: Path, config: Config, out: Path, progress: Progress
) -> CalibrationResult:
    """Calibrate all magnetometers of a bag and write `calibration.yaml` and a picture.

    Parameters
    ----------
    bag
        A drive through the mapped place.
    map_path
        Map file.
    config
        Configuration.
    out
        Folder for the results, made if it is missing.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    _check_outputs(out / CALIBRATION_FILE, out / OVERVIEW_FILE)
    recording = _read(bag, config, progress)
    state = load_map(map_path)
    field_map, map_frame = map_of(state, progress), state.provenance.get("frame")
    source = source_file(map_path)
    _check_frame(map_path, map_frame, recording)
    result = calibrate(recording, field_map, config.calibration, source, progress)
    result = replace(result, options=config.model_dump(mode="json"))
    figure = calibration_figure(field_map, recording.trajectory, result, truth=())
    _ensure_folder(out)
    write_calibration(out / CALIBRATION_FILE, result)
    save_figure(figure, out / OVERVIEW_FILE)
    return result


def _check_frame(map_path: Path, map_frame: object, recording: Recording) -> None:
    """Raise a MapError if map and drive are said to be in different frames."""
    if map_frame not in (None, recording.trajectory.frame):
        msg = (
            f"{map_path} is in frame {map_frame!r}, the poses of {recording.source.path} are in "
            f"{recording.trajectory.frame!r}; if both mean the same, say so with "
            f"`bag.frame: {map_frame}`"
        )
        raise MapError(msg)


def simulate_bags(
    out: Path, options: ScenarioOptions, kinds: Sequence[BagKind], progress: Progress
) -> Scenario:
    """Simulate a mapping and a calibration drive and write them as bags, with the truth.

    Parameters
    ----------
    out
        Folder for `mapping_*` and `calibration_*` bags, `suite.yaml` and `truth.yaml`.
    options
        The world and the drives.
    kinds
        Kinds of bag to write.
    progress
        Called with a stage and the fraction of it that is done.
    """
    scenario = simulate(options, progress)
    _ensure_folder(out)
    for index, kind in enumerate(kinds):
        progress("writing bags", index / len(kinds))
        for name, drive in (("mapping", scenario.mapping), ("calibration", scenario.calibration)):
            path = out / bag_name(name, kind)
            write_bag(path, kind, drive.recording, BagOptions(noise=options.noise))
    progress("writing bags", 1.0)
    facts = {"simulation": options.model_dump(mode="json")}
    write_known_sensors(
        out / "suite.yaml",
        scenario.suite,
        facts,
        "The mapping suite's own calibrations: what `l2m map build --suite` needs.",
    )
    write_known_sensors(
        out / "truth.yaml",
        scenario.truth,
        facts,
        "The true positions and distortions of the sensors in the calibration drive.",
    )
    return scenario


def bag_name(drive: str, kind: BagKind) -> str:
    """Return the file or folder name of a simulated bag."""
    suffix = {BagKind.ROS1: "_ros1.bag", BagKind.SQLITE3: "_sqlite3", BagKind.MCAP: "_mcap"}
    return drive + suffix[kind]


def _read(bag: Path, config: Config, progress: Progress) -> Recording:
    return read_recording(bag, config.bag, _counter(f"reading {bag.name}", progress))


def _counter(stage: str, progress: Progress) -> Callable[[int, int], None]:
    """Return what a reader calls with the messages read and their number."""
    return lambda done, total: progress(stage, done / max(total, 1))


def _check_outputs(*files: Path, suffix: str | None = None) -> None:
    """Raise an OutputError, before any work is done, for files that cannot be written."""
    for file in files:
        if suffix is not None and file.suffix != suffix:
            raise OutputError(f"{file}: the name must end in {suffix}")
        if file.exists() and not file.is_file():
            raise OutputError(f"{file}: exists and is not a regular file; choose another --out")
        if file.parent.exists() and not file.parent.is_dir():
            raise OutputError(f"{file.parent}: is a file, --out needs a folder; choose another")


def _ensure_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{folder}: cannot be made as a folder for results: {error.strerror}"
        raise OutputError(msg) from error
