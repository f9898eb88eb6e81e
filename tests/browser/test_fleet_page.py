"""The fleet's page in a real browser: seen, sorted by keyboard, and no name runs in it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.qa.fleet import with_outliers
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.qa.report.fleet_page import fleet_page
from l2m_gtsam.records.fleet import FleetRow
from tests.drives import hostile
from tests.drives.fleet_rows import row, sensor_row
from tests.drives.hostile import NAMES
from tests.support.browsing import (
    Looked,
    check_accessibility,
    check_figures,
    check_phone,
    check_silence,
    check_values,
    look,
    missing_names,
    told_by,
)

MOST_BYTES = 350_000  # 96 rows: a fleet of 800 then stays below three megabytes
DRIVES = 12  # of one vehicle, more than nine: day 2 comes before day 10
OTHERS = 3  # of each other vehicle
HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(2)>$\\frac{',
    "</style></svg><svg onload=alert(3)>{{ 7 * 7 }}",
)
BROKEN = "javascript:alert(4)//<b>cut</b>.bag"


def hostile_rows() -> list[FleetRow]:
    """A fleet with names that are markup; a sensor moved, some drives failed."""
    rng = np.random.default_rng(4)
    rows = []
    counts = (DRIVES, OTHERS, OTHERS)
    for vehicle, name, count in zip(HOSTILE, HOSTILE[1:] + HOSTILE[:1], counts, strict=True):
        for day in range(count):
            t = np.array([0.3, -0.1, 0.2]) + rng.normal(0, 0.002, 3)
            verdict = ("pass", "warn", "fail")[day % 3]
            found = sensor_row(name, t=tuple(t), verdict=verdict, reason=HOSTILE[day % 3])
            where = {"vehicle": vehicle, "bag": f"{HOSTILE[1]}_{day}", "folder": f"a b/{day}"}
            rows.append(row(day, found, **where))
    loose = rows[0].sensor
    assert loose is not None
    rows[0] = replace(rows[0], sensor=replace(loose, t=(0.9, -0.1, 0.2)))
    failed = FleetRow(HOSTILE[0], BROKEN, "v/b", "", 0.0, None, f"{BROKEN}: {HOSTILE[2]}")
    return [*rows, failed, *hostile.fleet_rows()]


@dataclass(frozen=True)
class Sorted:
    """What ``sort.js`` tells: of each press of Enter on a column, its state and its cells."""

    presses: list[dict[str, Any]]
    errors: list[str]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fleet") / "index.html"
    options = FleetOptions()
    path.write_text(fleet_page(with_outliers(hostile_rows(), options), options), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def looked(browser: str, page: Path) -> Looked:
    return look(browser, page)


@pytest.fixture(scope="module")
def sorting(browser: str, page: Path) -> Sorted:
    columns = ("bag", "x (mm)", "x (mm)", "verdict", "verdict")
    told = told_by("sort.js", browser, page, *columns)
    return Sorted(told["presses"], told["errors"])


def test_nothing_is_reported_on_the_console_or_loaded(looked: Looked) -> None:
    check_silence(looked)


def test_every_trend_is_seen(looked: Looked) -> None:
    check_figures(looked, len(HOSTILE) + len(NAMES))


def test_it_fits_a_phone(looked: Looked) -> None:
    check_phone(looked)


def test_every_figure_has_values_under_the_pointer(looked: Looked) -> None:
    check_values(looked)


def test_accessibility_has_no_grave_fault(looked: Looked) -> None:
    check_accessibility(looked)


def test_names_are_text(looked: Looked) -> None:
    for each in looked.looks:
        assert all(name in each["text"] for name in (*HOSTILE, BROKEN))
        assert missing_names(each["text"]) == []


def test_failures_stand_on_top(looked: Looked) -> None:
    for each in looked.looks:
        text = each["text"]
        assert text.index(BROKEN) < text.index("Trends\n\n") < text.index("All drives\n\n")


def test_it_is_small() -> None:
    rows = [
        row(day, sensor_row(name), vehicle=vehicle)
        for vehicle in ("truck_1", "truck_2", "truck_3", "truck_4")
        for day in range(DRIVES)
        for name in ("mag_0", "mag_1")
    ]
    assert len(fleet_page(rows, FleetOptions())) < MOST_BYTES


def test_columns_are_sorted_by_keyboard(sorting: Sorted) -> None:
    assert sorting.errors == []
    bags, rising, falling, good, bad = sorting.presses
    assert [each["sort"] for each in sorting.presses] == [
        *("ascending", "ascending", "descending", "ascending", "descending")
    ]
    assert all(each["others"] == 0 for each in sorting.presses)
    rows = hostile_rows()
    assert all(len(each["cells"]) == len(rows) for each in sorting.presses)
    ours = [cell for cell in bags["cells"] if cell.startswith(f"{HOSTILE[1]}_")]
    numbers = [int(cell.rpartition("_")[2]) for cell in ours]
    assert numbers == sorted([*range(DRIVES), *(2 * [*range(OTHERS)])])  # day 2 before day 10
    failed = sum(each.sensor is None for each in rows)
    for press, turned in ((rising, 1), (falling, -1)):
        assert press["cells"][-failed:] == [""] * failed  # blanks last either way
        x = [turned * float(cell.split(" ")[0]) for cell in press["cells"][:-failed]]
        assert x == sorted(x)
    assert "PASS" in good["cells"][0]
    assert "ERROR" in bad["cells"][0]
