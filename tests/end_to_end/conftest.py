"""The demonstration and a small fleet on disk, made once for all tests of the command line."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drives.fleet_runs import FleetRun, small_fleet
from tests.drives.yard import CalibratedYard, calibrated_yard
from tests.support.command_line import Demo, l2m
from tests.support.computed_once import computed_once
from tests.support.left_out import no_pages, texts_parsed_once
from tests.worlds.halls import SMALL_HALL
from tests.worlds.yard import Yard


@pytest.fixture(scope="module")
def without_pages() -> Iterator[None]:
    """Draw no pages and pictures, which take a second each and are looked at in other tests."""
    with no_pages():
        yield


@pytest.fixture(scope="module")
def texts_read_once() -> Iterator[None]:
    """Parse a text of YAML once, however often it is read."""
    with texts_parsed_once():
        yield


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    """Run the demonstration in a small hall: the tutorial's, with its map and calibration."""
    folder = tmp_path_factory.mktemp("demo")
    options = folder / "hall.yaml"
    options.write_text(json.dumps(SMALL_HALL))  # JSON is YAML
    with computed_once():
        return Demo(folder, l2m("demo", "--options", options, "--out", folder).out)


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> CalibratedYard:
    """The yard with its map and the calibration of a drive through it."""
    return calibrated_yard(tmp_path_factory)


@pytest.fixture(scope="session")
def yard(place: CalibratedYard) -> Yard:
    return place.yard


@pytest.fixture(scope="session")
def field_map(place: CalibratedYard) -> Path:
    return place.map


@pytest.fixture(scope="session")
def calibration(place: CalibratedYard) -> Path:
    return place.calibration


@pytest.fixture(scope="session")
def fleet_run(tmp_path_factory: pytest.TempPathFactory) -> FleetRun:
    """A small fleet that was run; tests that spoil it copy it first."""
    return small_fleet(tmp_path_factory)
