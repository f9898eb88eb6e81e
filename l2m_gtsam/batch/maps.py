"""Map files: built, updated, compared, described and drawn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from l2m_gtsam.batch.files import SavedMap, check_outputs, entries_of, surveyed_in
from l2m_gtsam.batch.survey import MappingDrives, read_survey, scanned_place
from l2m_gtsam.config import Config
from l2m_gtsam.data import LidarMap, Recording
from l2m_gtsam.errors import MapError
from l2m_gtsam.mapping.map_building import compare_recordings, update_map
from l2m_gtsam.maps.build import refuse_structure
from l2m_gtsam.maps.compare import MapComparison
from l2m_gtsam.maps.field_map import FieldMap, Remembering
from l2m_gtsam.progress import Progress, reported
from l2m_gtsam.records.map_diary import MapDiary
from l2m_gtsam.storage.files import ensure_folder
from l2m_gtsam.storage.map_file import save_map
from l2m_gtsam.upkeep.kept_map import drive_dates, kept_up
from l2m_gtsam.upkeep.surveys import map_surveys


@dataclass(frozen=True)
class DescribedMap:
    """A map, and where it came from: plain values of its file."""

    field_map: FieldMap
    provenance: dict[str, Any]

    @property
    def diary(self) -> MapDiary | None:
        """What it went through, if it remembers that."""
        return self.field_map.diary if isinstance(self.field_map, Remembering) else None


def build_map_file(
    bags: Sequence[Path],
    out: Path,
    config: Config,
    suite: Path | None,
    progress: Progress,
    structure: str | None = None,
    lidar: bool = False,
) -> DescribedMap:
    """Build a map from mapping bags and write it.

    Parameters
    ----------
    bags
        One or several mapping bags.
    out
        Map file to write (`.npz`).
    suite
        File with the mapping suite's calibrations; ideal sensors at the lidar's origin if absent.
    progress
        Called with a stage and the fraction of it that is done.
    structure
        What a LiDAR saw: a `.pcd`, `.ply` or `.npz` file in the map frame, else the name of a
        PointCloud2 topic of the bags.
    lidar
        Whether the cloud of the bags' scans is saved with it.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    check_outputs(out, suffix=".npz")
    if structure is not None:
        refuse_structure(config.mapping.model.kind)
    survey = read_survey(bags, config, suite, structure, progress)
    scanned = scanned_place(bags, survey.recordings, config, progress) if lidar else None
    with reported("building the map", progress):
        field_map = map_surveys(
            survey.recordings,
            survey.suite,
            config.mapping,
            config.calibration.changes,
            survey.cloud,
        )
    provenance = {
        "bags": [vars(recording.source) for recording in survey.recordings],
        "suite": survey.suite_file,
        "structure": None if survey.structure is None else survey.structure.provenance,
        "lidar": None if scanned is None else scanned.provenance,
        "frame": survey.recordings[0].trajectory.frame,
        "surveyed": vars(drive_dates(*survey.recordings)),
        "config": config.model_dump(mode="json", include={"bag", "mapping"}),
        "version": version("l2m-gtsam"),
    }
    return write_map(out, field_map, provenance, None if scanned is None else scanned.lidar)


def update_map_file(
    map_path: Path,
    bags: Sequence[Path],
    out: Path,
    config: Config,
    suite: Path | None,
    progress: Progress,
) -> DescribedMap:
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
    check_outputs(out, suffix=".npz")
    saved, field_map, drives = _with_drives(map_path, bags, config, suite, progress)
    with reported("updating the map", progress):
        updated = update_map(field_map, drives.recordings, drives.suite, config.mapping)
    return _write_updated(out, updated, saved, drives, config)


def keep_map_file_up(
    map_path: Path,
    bags: Sequence[Path],
    out: Path,
    config: Config,
    suite: Path | None,
    progress: Progress,
) -> DescribedMap:
    """Add drives of a calibrated vehicle to a map, and record what has changed since.

    Parameters
    ----------
    map_path
        Map file; it stays as it is unless it is also `out`, and until all is done.
    bags
        One or several drives, later than all that the map has been given, in its frame.
    out
        Map file to write (`.npz`).
    config
        Configuration, of which what is read and synchronised counts, and how changes are looked
        for (`calibration.changes`).
    suite
        File with the calibration of the vehicle's sensors.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    check_outputs(out, suffix=".npz")
    if suite is None:
        raise MapError(
            "--changes needs a calibrated vehicle: else steel of the place and of the vehicle are "
            "confused; give its calibration with --suite"
        )
    saved, field_map, drives = _with_drives(map_path, bags, config, suite, progress)
    with reported("looking for what changed", progress):
        kept = kept_up(
            field_map,
            drives.recordings,
            drives.suite or {},
            config.mapping,
            config.calibration.changes,
            surveyed_in(saved.state.provenance),
        )
    return _write_updated(out, kept, saved, drives, config)


def _with_drives(
    map_path: Path, bags: Sequence[Path], config: Config, suite: Path | None, progress: Progress
) -> tuple[SavedMap, FieldMap, MappingDrives]:
    """Return a map with the drives that it is to be given, none of which it has."""
    saved = SavedMap.read(map_path)
    known = saved.bags
    drives = read_survey(bags, config, suite, None, progress)
    _check_new(map_path, known, drives.recordings)
    return saved, saved.open(progress, drives.recordings), drives


def _write_updated(
    out: Path, updated: FieldMap, saved: SavedMap, drives: MappingDrives, config: Config
) -> DescribedMap:
    """Write a saved map after it was given drives."""
    added = [vars(recording.source) for recording in drives.recordings]
    update = {
        "bags": added,
        "suite": drives.suite_file,
        "config": config.model_dump(mode="json", include={"bag": True, "mapping": {"sync"}}),
        "version": version("l2m-gtsam"),
    }
    before = saved.state.provenance
    provenance = {
        **before,
        **updated.to_state().provenance,
        "bags": [*saved.bags, *added],
        "updates": [*entries_of(before, "updates"), update],
        "frame": drives.recordings[0].trajectory.frame,
    }
    return write_map(out, updated, provenance, saved.state.lidar)


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
    survey = read_survey(bags, config, suite, structure, progress)
    return compare_recordings(
        survey.recordings, survey.suite, config.mapping, survey.cloud, progress
    )


def describe_map_file(path: Path, progress: Progress) -> DescribedMap:
    """Return what a map file holds and where it came from."""
    saved = SavedMap.read(path)
    return DescribedMap(saved.open(progress), saved.state.provenance)


def plot_map_file(path: Path, out: Path, height: float | None, progress: Progress) -> None:
    """Draw a map at a height in metres (the middle of its readings if None) as a picture."""
    # Pictures need matplotlib, which takes a third of a second to import.
    from l2m_gtsam.qa.report.figures.map import map_figure
    from l2m_gtsam.qa.report.svg import save_figure

    check_outputs(out, suffix=".png")
    field_map = SavedMap.read(path).open(progress)
    ensure_folder(out.parent)
    save_figure(map_figure(field_map, height), out)


def write_map(
    out: Path, field_map: FieldMap, provenance: dict[str, Any], lidar: LidarMap | None
) -> DescribedMap:
    """Write a map with where it came from, besides what it says of itself."""
    state = field_map.to_state()
    state = replace(state, provenance={**state.provenance, **provenance}, lidar=lidar)
    ensure_folder(out.parent)
    save_map(out, state)
    return DescribedMap(field_map, state.provenance)


def _check_new(
    map_path: Path, known: Sequence[dict[str, Any]], recordings: Sequence[Recording]
) -> None:
    """Raise a MapError for a recording that a map has: its errors would count twice."""
    digests = [bag.get("sha256") for bag in known]
    if twice := [each.source.path for each in recordings if each.source.sha256 in digests]:
        raise MapError(f"{map_path} was made from {twice[0]} already; give bags that are new")
