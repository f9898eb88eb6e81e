"""The page of a localisation in a real browser: seen, read, and nothing of a bag runs in it."""

from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.localisation_page import localisation_page
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.records.provenance import NamedSource
from tests.drives.hostile import localisation
from tests.drives.localised import record
from tests.support.browsing import (
    BAG,
    HOSTILE,
    Looked,
    check_accessibility,
    check_figures,
    check_phone,
    check_silence,
    check_values,
    look,
    missing_names,
)

FIGURES = 6 + 2 * 5  # of the whole with a truth, and of each refined sensor
NOTE = "<i onclick=alert(5)>mag_9</i> is left out"


def hostile() -> LocalisationRecord:
    """A localisation with names that are markup."""
    told, names = record(), dict(zip(["mag_00", "mag_01"], HOSTILE.values(), strict=False))
    sensors = [
        replace(each, use=replace(each.use, sensor=names[each.use.sensor])) for each in told.sensors
    ]
    return replace(
        told,
        sensors=tuple(sensors),
        refined=tuple(replace(each, sensor=names[each.sensor]) for each in told.refined),
        notes=(*localisation().notes, NOTE),
        message="the map explains <b>most</b> of the readings",
        sources=(*localisation().sources, NamedSource("drive", BAG, "ab12")),
        options={"slam": {"</pre><script>alert(6)</script>": 1}},
    )


@pytest.fixture(scope="module")
def looked(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Looked:
    folder: Path = tmp_path_factory.mktemp("localisation")
    page = folder / "report.html"
    page.write_text(localisation_page(hostile(), QaOptions(), Identity("0" * 64)), encoding="utf-8")
    return look(browser, page)


def test_nothing_is_reported_on_the_console_or_loaded(looked: Looked) -> None:
    check_silence(looked)


def test_every_figure_is_seen_on_a_desk_and_on_a_phone(looked: Looked) -> None:
    check_figures(looked, FIGURES)
    check_phone(looked)


def test_every_figure_has_values_under_the_pointer(looked: Looked) -> None:
    check_values(looked)


def test_accessibility_has_no_grave_fault(looked: Looked) -> None:
    check_accessibility(looked)
    names = [stop["name"] for stop in looked.tabbed]
    assert names[0] == "Skip to the report"
    assert all(stop["outline"] != "none" for stop in looked.tabbed)


def test_names_from_a_bag_are_text(looked: Looked) -> None:
    shown = (*list(HOSTILE.values())[:2], BAG, NOTE, "<b>most</b>")
    for each in looked.looks:
        assert all(name in each["text"] for name in shown)
        assert missing_names(each["text"]) == []
        assert each["title"].startswith("WARN: localisation over ")


def test_light_and_dark_differ(looked: Looked) -> None:
    assert len({each["background"] for each in looked.looks}) == 2
