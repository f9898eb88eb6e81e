"""Which drives a fleet made: from a folder or a manifest."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from l2m_gtsam.errors import BagError, ConfigError
from l2m_gtsam.records.fleet import DATE
from l2m_gtsam.storage.drive_lists import (
    FILES,
    ManifestEntry,
    find_bags,
    is_bag,
    is_folder,
    read_manifest,
)
from l2m_gtsam.storage.files import folder_names

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
        What tells it from any other drive, wherever all of them are moved to: paths as seen from
        the folder or the manifest.
    date
        When it was, UTC, ISO 8601, where the stamps are not to be asked; else empty.
    folder
        For the results, relative to that of the fleet, with slashes.
    """

    bag: Path
    map_path: Path
    config: Path | None
    vehicle: str
    listed: str
    date: str = ""
    folder: str = ""

    @property
    def name(self) -> str:
        """The bag's name for its folder."""
        return self.bag.stem if self.bag.suffix.lower() in FILES else self.bag.name


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
            f"{order.source}: no bags in it; accepted: ROS1 .bag, .mcap, .db3, ROS2 folders"
        )
    if order.map_path is None:
        raise ConfigError(f"{order.source}: a folder of bags needs a map; give it with --map")
    return [
        FleetDrive(
            bag,
            order.map_path,
            order.config,
            _vehicle(bag),
            _seen_from(order.source, bag),
        )
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
        _seen_from(folder, path) for path in (entry.bag, entry.map, entry.config) if path
    )
    config = entry.config or order.config
    return FleetDrive(entry.bag, map_path, config, entry.vehicle, listed, date)


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
