"""A manifest: which drives a fleet made, as YAML."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.storage.yaml_file import read_yaml

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
        told = {"year": date.year, "first": first, "last": last}
        raise PydanticCustomError("date", "year {year}; accepted: {first} to {last}", told)
    return _utc(date)


def _utc(date: datetime) -> datetime:
    return date.replace(tzinfo=UTC) if date.tzinfo is None else date.astimezone(UTC)


class ManifestEntry(Options):
    """A drive of the fleet; paths are relative to the manifest."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    bag: Path
    """ROS1 .bag, ROS2 folder, .db3 or .mcap."""
    vehicle: str = Field(min_length=1, max_length=200)
    """Name or number of the vehicle."""
    map: Path | None = None
    """Map file, that of the command line if not given."""
    config: Path | None = None
    """YAML configuration, that of the command line if not given."""
    date: Annotated[datetime, BeforeValidator(_no_number), AfterValidator(_in_utc)] | None = None
    """When the drive was, in UTC if it names no zone, instead of what the bag's stamps say."""


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
    return f"{where}: {fault['msg']}"


def _seen_from_here(folder: Path, entry: ManifestEntry) -> ManifestEntry:
    paths = {"bag": entry.bag, "map": entry.map, "config": entry.config}
    found = {name: None if path is None else folder / path for name, path in paths.items()}
    return entry.model_copy(update=found)
