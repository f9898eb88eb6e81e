"""A small fleet that was run through the command line."""

import csv
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest

from l2m_gtsam.batch.fleet_task import FleetOrder
from tests.drives.fleets import Place, make_place, not_a_bag, truncated, vehicle
from tests.support.command_line import Finished, l2m
from tests.support.made_once import made_once

SAID = "said.json"  # what was printed
HOSTILE = "<img src=x onerror=alert(1)>.bag"


@dataclass(frozen=True)
class FleetRun:
    """A fleet that was run: its files, and what was printed."""

    place: Place
    bags: Path
    out: Path
    said: Finished

    def copied(self, folder: Path) -> "FleetRun":
        """Return the same elsewhere, to be spoiled."""
        for name in ("bags", "out", "place"):
            shutil.copytree(self.out.parent / name, folder / name)
        place = Place(folder / "place" / "map.npz", folder / "place" / "fleet.yaml")
        return FleetRun(place, folder / "bags", folder / "out", self.said)

    @property
    def order(self) -> FleetOrder:
        """What was wanted."""
        return FleetOrder(self.bags, self.place.map, self.place.config, self.out)


def small_fleet(factory: pytest.TempPathFactory) -> FleetRun:
    """Return the fleet of this run of the tests; tests that spoil it copy it first."""
    folder = made_once(factory, "fleet", _run)
    place = Place(folder / "place" / "map.npz", folder / "place" / "fleet.yaml")
    said = Finished(**json.loads((folder / SAID).read_text()))
    return FleetRun(place, folder / "bags", folder / "out", said)


def _run(folder: Path) -> None:
    """Run two bags of one vehicle and two of another, which are broken."""
    place, bags, out = make_place(folder / "place"), folder / "bags", folder / "out"
    vehicle(bags / "truck_1" / "day_0.bag", seed=1)
    vehicle(bags / "truck_1" / "day_9.mcap", seed=2, day=9)
    truncated(bags / "truck_2" / "day_1.bag")
    not_a_bag(bags / "truck_2" / HOSTILE)
    where = ("--map", place.map, "--config", place.config, "--out", out)
    said = l2m("batch", bags, *where, "--workers", "1")
    (folder / SAID).write_text(json.dumps(asdict(said)))


def table(out: Path) -> list[dict[str, str]]:
    with (out / "fleet.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
