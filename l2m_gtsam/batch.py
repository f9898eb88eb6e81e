"""Files in, files out: what the command line does, callable from Python."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.calibrate import calibrate
from l2m_gtsam.config import Config
from l2m_gtsam.data import FloatArray, KnownSensor, MapState, Recording
from l2m_gtsam.errors import MapError, OutputError
from l2m_gtsam.mapping import (
    compare_recordings,
    map_recordings,
    update_map,
)
from l2m_gtsam.maps.build import map_from_state, refuse_structure
from l2m_gtsam.maps.compare import MapComparison
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.plan import assumed_recording, plan
from l2m_gtsam.qa.figures import calibration_figure, map_figure, save_figure
from l2m_gtsam.qa.tables import MapDescription
from l2m_gtsam.results import CalibrationResult, DrivePlan
from l2m_gtsam.simulate.bag_writer import BagKind, BagOptions, write_bag
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions, simulate
from l2m_gtsam.storage.bag import has_fields, read_recording, read_trajectory
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.cloud import read_cloud, write_cloud
from l2m_gtsam.storage.cloud_topic import CloudTopicOptions, read_cloud_topic
from l2m_gtsam.storage.digest import source_file
from l2m_gtsam.storage.inspect import BagReport, inspect_bag
from l2m_gtsam.storage.known_sensors import read_known_sensors, write_known_sensors
from l2m_gtsam.storage.map_file import load_map, save_map

Progress = Callable[[str, float], None]

CALIBRATION_FILE = "calibration.yaml"
OVERVIEW_FILE = "overview.png"
SUITE_FILE, TRUTH_FILE, STRUCTURE_FILE = "suite.yaml", "truth.yaml", "structure.ply"


@dataclass(frozen=True)
class BuiltMap:
    """A map and what its file says of it."""

    field_map: FieldMap
    description: MapDescription


@dataclass(frozen=True)
class Structure:
    """A structure cloud in the map frame in metres, shape (M, 3), and where it came from."""

    points: FloatArray
    provenance: dict[str, Any]


@dataclass(frozen=True)
class Survey:
    """Mapping bags and what was given with them.

    Attributes
    ----------
    recordings
        One per bag.
    suite
        Sensors of the mapping suite by name; absent where all are ideal.
    structure
        What a LiDAR saw, if that was given.
    """

    recordings: list[Recording]
    suite: dict[str, KnownSensor] | None
    structure: Structure | None

    @property
    def cloud(self) -> FloatArray | None:
        """Points of the structure in metres, shape (M, 3), if there is one."""
        return None if self.structure is None else self.structure.points


def build_map_file(
    bags: Sequence[Path],
    out: Path,
    config: Config,
    suite: Path | None,
    progress: Progress,
    structure: str | None = None,
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
    structure
        What a LiDAR saw: a `.pcd`, `.ply` or `.npz` file in the map frame, else the name of a
        PointCloud2 topic of the bags.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    _check_outputs(out, suffix=".npz")
    if structure is not None:
        refuse_structure(config.mapping.model.kind)
    survey = _read_survey(bags, config, suite, structure, progress)
    progress("building the map", 0.0)
    field_map = map_recordings(survey.recordings, survey.suite, config.mapping, survey.cloud)
    progress("building the map", 1.0)
    provenance = {
        "bags": [vars(recording.source) for recording in survey.recordings],
        "suite": None if suite is None else vars(source_file(suite)),
        "structure": None if survey.structure is None else survey.structure.provenance,
        "frame": survey.recordings[0].trajectory.frame,
        "config": config.model_dump(mode="json", include={"bag", "mapping"}),
        "version": version("l2m-gtsam"),
    }
    return _save_map(out, field_map, provenance)


def update_map_file(
    map_path: Path,
    bags: Sequence[Path],
    out: Path,
    config: Config,
    suite: Path | None,
    progress: Progress,
) -> BuiltMap:
    """Add the readings of more mapping bags to a map, which keeps its kind and its prior.

    Parameters
    ----------
    map_path
        Map file; it stays as it is unless it is also `out`.
    bags
        One or several mapping bags that are not in the map yet, in its frame.
    out
        Map file to write (`.npz`).
    config
        Configuration, of which only what is read and synchronised counts.
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
    state = load_map(map_path)
    known = _known_bags(map_path, state.provenance)
    field_map = map_of(state, progress)
    survey = _read_survey(bags, config, suite, None, progress)
    for recording in survey.recordings:
        _check_frame(map_path, state.provenance.get("frame"), recording)
        _check_new(map_path, known, recording)
    progress("updating the map", 0.0)
    updated = update_map(field_map, survey.recordings, survey.suite, config.mapping)
    progress("updating the map", 1.0)
    added = [vars(recording.source) for recording in survey.recordings]
    update = {
        "bags": added,
        "suite": None if suite is None else vars(source_file(suite)),
        "config": config.model_dump(mode="json", include={"bag": True, "mapping": {"sync"}}),
        "version": version("l2m-gtsam"),
    }
    provenance = {
        **state.provenance,
        **updated.to_state().provenance,
        "bags": [*known, *added],
        "updates": [*_list_of(state.provenance, "updates"), update],
        "frame": survey.recordings[0].trajectory.frame,
    }
    return _save_map(out, updated, provenance)


def compare_map_kinds(
    bags: Sequence[Path],
    config: Config,
    suite: Path | None,
    structure: str | None,
    progress: Progress,
) -> MapComparison:
    """Compare the kinds of maps that mapping bags could become, on held-out places.

    Parameters
    ----------
    bags, config, suite, structure, progress
        As in ``build_map_file``; the structure only serves the kind that can use it.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    if structure is not None:
        refuse_structure(*config.mapping.compare.kinds)
    survey = _read_survey(bags, config, suite, structure, progress)
    return compare_recordings(
        survey.recordings, survey.suite, config.mapping, survey.cloud, progress
    )


def _read_survey(
    bags: Sequence[Path],
    config: Config,
    suite: Path | None,
    structure: str | None,
    progress: Progress,
) -> Survey:
    """Return everything that a map is made of; files before bags, which take longer."""
    known = None if suite is None else read_known_sensors(suite)
    options = config.mapping.structure
    is_file = structure is not None and _names_file(structure)
    cloud = _structure_file(Path(structure or ""), options) if is_file else None
    recordings = [_read(bag, config, progress) for bag in bags]
    if structure is not None and not is_file:
        cloud = _structure_topic(structure, bags, recordings, config, progress)
    return Survey(recordings, known, cloud)


def _names_file(structure: str) -> bool:
    """Return whether a file is meant: names of topics have no dots."""
    return Path(structure).suffix != "" or Path(structure).is_file()


def _structure_file(path: Path, options: CloudTopicOptions) -> Structure:
    return Structure(read_cloud(path, options.edge), vars(source_file(path)))


def _structure_topic(
    topic: str,
    bags: Sequence[Path],
    recordings: Sequence[Recording],
    config: Config,
    progress: Progress,
) -> Structure:
    """Return what the scans of all bags saw, placed by their poses."""
    clouds = [
        read_cloud_topic(
            bag,
            topic,
            recording.trajectory,
            config.mapping.structure,
            config.bag.stamps,
            _counter(f"reading {topic} of {bag.name}", progress),
        )
        for bag, recording in zip(bags, recordings, strict=True)
    ]
    provenance = {
        "topic": topic,
        "scans": sum(cloud.scans for cloud in clouds),
        "scans_without_pose": sum(cloud.without_pose for cloud in clouds),
    }
    return Structure(np.concatenate([cloud.points for cloud in clouds]), provenance)


def _save_map(out: Path, field_map: FieldMap, provenance: dict[str, Any]) -> BuiltMap:
    """Write a map with where it came from, besides what it says of itself."""
    state = field_map.to_state()
    state = replace(state, provenance={**state.provenance, **provenance})
    _ensure_folder(out.parent)
    save_map(out, state)
    return BuiltMap(field_map, MapDescription(field_map.summary, state.provenance))


def _known_bags(map_path: Path, provenance: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the bags that a map was made from; the file may have been tampered with."""
    bags = _list_of(provenance, "bags")
    if not all(isinstance(bag, dict) for bag in bags):
        raise MapError(f"{map_path}: its list of bags is damaged; build the map again")
    return bags


def _list_of(provenance: dict[str, Any], name: str) -> list[Any]:
    entries = provenance.get(name)
    return entries if isinstance(entries, list) else []


def _check_new(map_path: Path, known: Sequence[dict[str, Any]], recording: Recording) -> None:
    """Raise a MapError for a recording that a map has: twice, it would count as two witnesses."""
    if recording.source.sha256 in [bag.get("sha256") for bag in known]:
        raise MapError(
            f"{map_path} was made from {recording.source.path} already; give bags that are new"
        )


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
    bag: Path,
    map_path: Path,
    config: Config,
    out: Path,
    progress: Progress,
    truth: tuple[KnownSensor, ...] = (),
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
    truth
        Sensors as they are, if that is known, to be drawn beside the estimate.

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
    figure = calibration_figure(field_map, recording.trajectory, result, truth)
    _ensure_folder(out)
    write_calibration(out / CALIBRATION_FILE, result)
    save_figure(figure, out / OVERVIEW_FILE)
    return result


def plan_bag(
    bag: Path,
    map_path: Path,
    config: Config,
    at: Sequence[tuple[float, float, float]],
    progress: Progress,
) -> DrivePlan:
    """Say what a drive will determine of its magnetometers, from poses and map alone.

    Parameters
    ----------
    bag
        A drive through the mapped place.
    map_path
        Map file.
    config
        Configuration; `calibration.start` says where the bag's sensors are assumed.
    at
        Places of sensors in the lidar frame in metres that are assumed instead of the bag's own; a
        bag without magnetometers has one at the lidar if none is given.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    state = load_map(map_path)
    if at or not has_fields(bag):
        names = {_named(place): place for place in at or [(0.0, 0.0, 0.0)]}
        trajectory, source = read_trajectory(bag, config.bag), source_file(bag)
        recording = assumed_recording(trajectory, source, tuple(names), config.plan.rate_hz)
        calibration = config.calibration.model_copy(update={"start": names})
    else:
        recording, calibration = _read(bag, config, progress), config.calibration
    _check_frame(map_path, state.provenance.get("frame"), recording)
    return plan(recording, map_of(state, progress), calibration, config.plan, progress)


def _named(place: tuple[float, float, float]) -> str:
    """Return the name of a sensor that is only assumed."""
    return f"at {place[0]:g},{place[1]:g},{place[2]:g}"


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
        Folder for `mapping_*` and `calibration_*` bags, `suite.yaml`, `truth.yaml` and
        `structure.ply`, what a LiDAR sees of the steel.
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
    write_cloud(out / STRUCTURE_FILE, scenario.cloud)
    facts = {"simulation": options.model_dump(mode="json")}
    write_known_sensors(
        out / SUITE_FILE,
        scenario.suite,
        facts,
        "The mapping suite's own calibrations: what `l2m map build --suite` needs.",
    )
    write_known_sensors(
        out / TRUTH_FILE,
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
