"""Lists of the drives of a fleet: bags found in a folder, or a manifest in YAML."""

import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, NoReturn, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from l2m_gtsam.errors import BagError, ConfigError
from l2m_gtsam.options import Options, words_of
from l2m_gtsam.storage.log import DRIVES
from l2m_gtsam.storage.yaml_file import read_yaml

ROS2_HEADER = "metadata.yaml"


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: by the name of a file, or by what a folder holds.

    Raises
    ------
    BagError
        It is not known, because a folder cannot be read.
    """
    if is_folder(path):
        try:
            return (path / ROS2_HEADER).is_file()
        except OSError as error:
            _unreadable(path, error)
    return _named(path.name)


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder; a BagError if the one that it lies in is closed."""
    try:
        return path.is_dir()
    except OSError as error:
        _unreadable(path, error)


def find_bags(folder: Path, without: Path) -> list[Path]:
    """Return every bag in a folder and below it, in order of their paths.

    Parameters
    ----------
    folder
        Itself a bag, or where they are looked for; links to folders that are no bag are not
        followed, names that begin with a dot are skipped.
    without
        Folder that is not looked into.

    Raises
    ------
    BagError
        A folder cannot be read: bags in it would be missing without a word.
    """
    return [folder] if is_bag(folder) else sorted(_below(folder, without.resolve()))


def _below(folder: Path, without: Path) -> Iterator[Path]:
    for name, folders, files in os.walk(folder, onerror=_cannot_be_listed):
        place = Path(name)
        shown = [place / each for each in folders if not each.startswith(".")]
        inside = [each for each in shown if each.resolve() != without]
        bags = [each for each in inside if is_bag(each)]
        yield from bags
        folders[:] = [each.name for each in inside if each not in bags]
        yield from (place / each for each in files if not each.startswith(".") and _named(each))


def _named(name: str) -> bool:
    return Path(name).suffix.lower() in DRIVES


def _cannot_be_listed(error: OSError) -> NoReturn:
    _unreadable(Path(str(error.filename)), error)


def _unreadable(path: Path, error: OSError) -> NoReturn:
    why = error.strerror or error
    raise BagError(
        f"{path}: cannot be read: {why}; allow reading it, move it elsewhere, or list the drives "
        "in a manifest"
    ) from error


MOST = 100_000  # drives
YEARS = (1970, 2200)  # of recordings: stamps begin with the first


def _no_number(value: Any) -> Any:
    """Refuse a number, which would be taken for seconds since 1970: mostly it is 20260502."""
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return value
    raise PydanticCustomError(
        "date",
        "{value} is a number; write a date as 2026-05-02",
        {"value": str(value).strip()[:40]},
    )


def _in_utc(date: datetime) -> datetime:
    first, last = YEARS
    # A year away from both, lest the zone leads out of what a datetime can hold.
    if not first - 1 <= date.year <= last + 1 or not first <= _utc(date).year <= last:
        facts = {"year": date.year, "first": first, "last": last}
        raise PydanticCustomError("date", "year {year}; accepted: {first} to {last}", facts)
    return _utc(date)


def _utc(date: datetime) -> datetime:
    return date.replace(tzinfo=UTC) if date.tzinfo is None else date.astimezone(UTC)


class ManifestEntry(Options):
    """A drive of the fleet; paths are relative to the manifest."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    bag: Path
    """ROS1 .bag, ROS2 folder, .db3, .mcap, .csv or .ulg."""
    vehicle: str = Field(min_length=1, max_length=200)
    """Name or number of the vehicle."""
    map: Path | None = None
    """Map file, that of the command line if not given."""
    config: Path | None = None
    """YAML configuration, that of the command line if not given."""
    poses: Path | None = None
    """Poses of this drive in a file of their own, as with `l2m calibrate --poses`."""
    pose_times: Path | None = None
    """Times of KITTI's poses, a line each, as with `--pose-times`."""
    date: Annotated[datetime, BeforeValidator(_no_number), AfterValidator(_in_utc)] | None = None
    """When the drive was, in UTC if it names no zone, instead of what the bag's stamps say."""

    @model_validator(mode="after")
    def _times_with_poses(self) -> Self:
        if self.pose_times is not None and self.poses is None:
            raise PydanticCustomError("poses", "pose_times goes with poses, a file of KITTI")
        return self


_ADAPTER = TypeAdapter(Annotated[tuple[ManifestEntry, ...], Field(min_length=1, max_length=MOST)])


def read_manifest(path: Path) -> tuple[ManifestEntry, ...]:
    """Return the drives in a manifest, with paths as seen from here.

    Raises
    ------
    ConfigError
        The file is missing, not YAML, or not a list of drives; the line names the first fault.
    """
    content = read_yaml(path, ConfigError)
    if not isinstance(content, list):
        raise ConfigError(f"{path}: not a list of drives; accepted: - {{bag: PATH, vehicle: NAME}}")
    try:
        entries = _ADAPTER.validate_python(content)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_fault(error)}") from error
    return tuple(_seen_from_here(path.parent, entry) for entry in entries)


def _fault(error: ValidationError) -> str:
    """Return the first fault in words."""
    fault = error.errors()[0]
    if not fault["loc"]:
        return fault["msg"]
    number, *keys = fault["loc"]
    where = ": ".join([f"drive {int(number) + 1}", *map(str, keys)])
    if fault["type"] == "extra_forbidden":
        return f"{where}: unknown key; accepted here: {', '.join(ManifestEntry.model_fields)}"
    return f"{where}: {words_of(fault)}"


def _seen_from_here(folder: Path, entry: ManifestEntry) -> ManifestEntry:
    names = ("bag", "map", "config", "poses", "pose_times")
    paths = {name: getattr(entry, name) for name in names}
    found = {name: None if path is None else folder / path for name, path in paths.items()}
    return entry.model_copy(update=found)
