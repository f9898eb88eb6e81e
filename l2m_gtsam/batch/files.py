"""Drives and maps opened from their files, tiles kept beside maps, folders for results."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from l2m_gtsam.config import Config
from l2m_gtsam.data import MapState, Recording, ScalarSeries, SourceFile
from l2m_gtsam.errors import BagError, CalibrationError, MapError, OutputError
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.field_map import FieldMap, Remembering, refuse_other_frame
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.options import Options, first_fault
from l2m_gtsam.progress import Progress, counter, reported
from l2m_gtsam.records.map_diary import UNDATED, MapDrive
from l2m_gtsam.records.provenance import MapOrigin, NamedSource
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.bag import read_recording
from l2m_gtsam.storage.files import source_file
from l2m_gtsam.storage.map_file import load_map
from l2m_gtsam.storage.regressors import read_scalars
from l2m_gtsam.storage.tile_folder import tiles_beside

USED = ("suite", "calibration")  # of a map: what it was made with besides readings
SavedOptions = TypeVar("SavedOptions", bound=Options)


def check_outputs(*files: Path, suffix: str | None = None) -> None:
    """Raise an OutputError, before any work is done, for files that cannot be written."""
    for file in files:
        if suffix is not None and file.suffix != suffix:
            raise OutputError(f"{file}: the name must end in {suffix}")
        if file.exists() and not file.is_file():
            raise OutputError(f"{file}: exists and is not a regular file; choose another --out")
        if file.parent.exists() and not file.parent.is_dir():
            raise OutputError(f"{file.parent}: is a file; a folder is needed there")


def check_not_replaced(out: Path, *sources: Path | None) -> None:
    """Raise an OutputError if a result would take the place of what it is made from."""
    if any(each is not None and out.exists() and out.samefile(each) for each in sources):
        raise OutputError(f"{out}: would be overwritten, but is read; choose another --out")


def with_tiles(field_map: FieldMap, path: Path) -> FieldMap:
    """Return a map that keeps its tiles, if it has any, beside its file."""
    if not isinstance(field_map, HarmonicMap):
        return field_map
    return field_map.with_store(tiles_beside(path))


def make_tiles(field_map: FieldMap, path: Path, progress: Progress) -> None:
    """Make all tiles of a map, if it has any, and keep them beside its file.

    Parameters
    ----------
    progress
        Called with a stage and the fraction of it that is done.
    """
    kept = with_tiles(field_map, path)
    if isinstance(kept, HarmonicMap):
        kept.make_tiles(counter("making tiles", progress))


def read_drive(bag: Path, config: Config, progress: Progress) -> Recording:
    """Return what a bag recorded, as far as the configuration reads it."""
    return read_recording(bag, config.bag, counter(f"reading {bag.name}", progress))


def read_drive_and_numbers(bag: Path, config: Config, progress: Progress) -> Recording:
    """Return what a bag recorded with the numbers that the configuration names."""
    scalars = read_numbers(bag, config, progress)
    return replace(read_drive(bag, config, progress), scalars=scalars)


def read_numbers(bag: Path, config: Config, progress: Progress) -> tuple[ScalarSeries, ...]:
    """Return the numbers of a bag that the configuration names."""
    count = counter(f"reading numbers of {bag.name}", progress)
    return read_scalars(bag, config.bag, count)


def check_bags(bags: Sequence[Path]) -> None:
    """Raise a BagError, before any is read, if there is no bag or one is listed twice."""
    if not bags:
        raise BagError("no bag is given: name one or several")
    places = [bag.resolve() for bag in bags]
    if twice := [str(bag) for k, bag in enumerate(bags) if places[k] in places[:k]]:
        raise BagError(f"{twice[0]} is listed twice; list each drive once")


@dataclass(frozen=True)
class SavedMap:
    """A map file that was read; its map is made when the drives that go with it are known.

    Attributes
    ----------
    state
        What it holds.
    """

    path: Path
    state: MapState

    @classmethod
    def read(cls, path: Path) -> "SavedMap":
        """Read a map file; a MapError if it is missing or not sound."""
        return cls(path, load_map(path))

    @property
    def bags(self) -> list[dict[str, Any]]:
        """What the file says of the bags that it was made from; it may have been tampered with."""
        bags = entries_of(self.state.provenance, "bags")
        if not all(isinstance(bag, dict) for bag in bags):
            raise MapError(f"{self.path}: its list of bags is damaged; build the map again")
        return bags

    @property
    def doubts(self) -> tuple[str, ...]:
        """What speaks against the calibrations that it was made with, half a sentence each."""
        return doubts_of_origin(self.state.provenance)

    def open(self, progress: Progress, drives: Sequence[Recording] = ()) -> FieldMap:
        """Return the map, ready to be asked.

        Parameters
        ----------
        progress
            Called with a stage and the fraction of it that is done.
        drives
            What it is going to be used with.

        Raises
        ------
        MapError
            A drive is said to be in another frame, or the map is not sound.
        """
        for drive in drives:
            self.check_frame(drive)
        with reported("loading the map", progress):
            try:
                return with_tiles(map_from_state(self.state), self.path)
            except MapError as error:
                raise MapError(f"{self.path}: {error}") from error

    def check_frame(self, drive: Recording) -> None:
        """Raise a MapError for a drive that is said to be in another frame."""
        refuse_other_frame(self.state.provenance.get("frame"), drive, str(self.path))


@dataclass(frozen=True)
class OpenMap:
    """A map that is ready to be asked.

    Attributes
    ----------
    saved
        What its file says of it, without its arrays.
    source, origin
        The file, and what the map was made from.
    """

    saved: SavedMap
    field_map: FieldMap
    source: SourceFile
    origin: MapOrigin

    @classmethod
    def of(cls, saved: SavedMap, progress: Progress, drives: Sequence[Recording] = ()) -> "OpenMap":
        """Return a map with what its file says of where it came from; see ``SavedMap.open``."""
        field_map = saved.open(progress, drives)
        diary = field_map.diary if isinstance(field_map, Remembering) else None
        later = () if diary is None else diary.drives[1:]
        updated = later[-1].ended if later else None
        origin = replace(origin_of(saved.state.provenance), updated=updated)
        bare = replace(saved, state=replace(saved.state, arrays={}))
        return cls(bare, field_map, source_file(saved.path), origin)


def map_notes(saved: SavedMap, field_map: FieldMap) -> tuple[str, ...]:
    """Return what whoever uses a map has to know of it, by itself and by its file, as notes."""
    return tuple(f"Of the map: {doubt}" for doubt in (*field_map.summary.doubts, *saved.doubts))


def used_file(path: Path, judgement: Level | None) -> dict[str, Any]:
    """Return what a map's file says of a calibration that it was made with."""
    verdict = {"verdict": Level.FAIL.value} if judgement is Level.FAIL else {}
    return {**vars(source_file(path)), **verdict}


def entries_of(provenance: dict[str, Any], name: str) -> list[Any]:
    """Return a list in what a map's file says, which may have been tampered with; empty if none."""
    entries = provenance.get(name)
    return entries if isinstance(entries, list) else []


def surveyed_in(provenance: dict[str, Any]) -> MapDrive:
    """Return when a map was surveyed; undated if its file does not say, or nonsense."""
    dates = provenance.get("surveyed")
    try:
        return MapDrive(**dates) if isinstance(dates, dict) else UNDATED
    except (TypeError, ValueError):
        return UNDATED


def origin_of(provenance: dict[str, Any]) -> MapOrigin:
    """Return what a map was made from.

    Parameters
    ----------
    provenance
        What the file of a map says of itself; it may have been tampered with.
    """
    later = [part for part in entries_of(provenance, "updates") if isinstance(part, dict)]
    files = [("survey", each) for each in entries_of(provenance, "bags")]
    files += [(name, provenance.get(name)) for name in USED]
    files += [("suite of an update", part.get("suite")) for part in later]
    files += [(name, provenance.get(name)) for name in ("structure", "lidar")]
    sources = (
        NamedSource(role, path, sha256)
        for role, each in files
        if isinstance(each, dict)
        and isinstance(path := each.get("path"), str)
        and isinstance(sha256 := each.get("sha256"), str)
    )
    return MapOrigin(surveyed_in(provenance), None, tuple(sources))


def doubts_of_origin(provenance: dict[str, Any]) -> tuple[str, ...]:
    """Return which calibrations that a map was made with were judged FAIL, half a sentence each.

    Parameters
    ----------
    provenance
        What the file of a map says of itself; it may have been tampered with.
    """
    parts = [provenance, *entries_of(provenance, "updates")]
    found = [part.get(name) for part in parts if isinstance(part, dict) for name in USED]
    return tuple(
        f"it was made with {each.get('path')}, whose verdict is FAIL"
        for each in found
        if isinstance(each, dict) and each.get("verdict") == Level.FAIL
    )


def saved_options(path: Path, options: Any, model: type[SavedOptions], *names: str) -> SavedOptions:
    """Return the options under some names of those that a calibration was made with."""
    for name in names:
        options = options.get(name, {}) if isinstance(options, dict) else options
    try:
        return model.model_validate(options)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {first_fault(error, 'options', *names)}") from error
