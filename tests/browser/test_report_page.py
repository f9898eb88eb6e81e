"""The report in a real browser: seen, read, tabbed through, and nothing of a bag runs in it."""

from pathlib import Path

import numpy as np
from PIL import Image

from l2m_gtsam.batch.reports import PDF_FILE, REPORT_FILE, report_folder
from tests.browser.conftest import BAG, HOSTILE, Looked

GRAVE = {"serious", "critical"}  # of axe-core
FIGURES = 4 + 3 * 8  # of vehicle and map, and of each sensor
SMALLEST_PX = 9.0  # text in figures; below it labels are not read on a phone
# A figure that failed to draw is a blank card: of one that is drawn at least this share differs
# from its background.
INKED = 0.01


def test_nothing_is_reported_on_the_console_or_loaded(looked: Looked) -> None:
    assert len(looked.looks) == 4
    for look in looked.looks:
        assert look["errors"] == []
        assert look["requests"] == []


def test_every_figure_is_seen(looked: Looked) -> None:
    for look in looked.looks:
        assert len(look["figures"]) == FIGURES
        for figure in look["figures"]:
            assert figure["alt"]
            assert figure["visible"]
            assert figure["inside"]
            assert figure["drawn"] > 5
            assert min(figure["width"], figure["height"]) > 100


def test_it_fits_a_phone(looked: Looked) -> None:
    for look in looked.looks:
        assert not look["wider"]
        assert look["smallest_text"] >= SMALLEST_PX


def test_light_and_dark_differ(looked: Looked) -> None:
    light, dark = (
        np.asarray(Image.open(looked.folder / f"desk-{scheme}.png").convert("L"), dtype=float)
        for scheme in ("light", "dark")
    )
    assert np.median(light) > 200
    assert np.median(dark) < 60
    for picture in (light, dark):
        assert np.mean(np.abs(picture - np.median(picture)) > 40) > INKED


def test_accessibility_has_no_grave_fault(looked: Looked) -> None:
    for look in looked.looks:
        assert [each for each in look["accessibility"] if each["impact"] in GRAVE] == []


def test_it_is_used_by_keyboard(looked: Looked) -> None:
    names = [stop["name"] for stop in looked.tabbed]
    assert names[0] == "Skip to the report"
    assert "Verdicts" in names
    assert any("All parameters" in name for name in names)
    assert all(stop["outline"] != "none" for stop in looked.tabbed)


def test_names_from_a_bag_are_text(looked: Looked) -> None:
    for look in looked.looks:
        assert all(name in look["text"] for name in (*HOSTILE.values(), BAG))
        assert look["title"].startswith("FAIL")


def test_a_report_is_printed(browser: str, hostile_report: Path) -> None:
    assert browser
    report_folder(hostile_report, None, pdf=True)
    content = (hostile_report / PDF_FILE).read_bytes()
    assert content.startswith(b"%PDF")
    assert content.count(b"/Type /Page") >= 4
    assert (hostile_report / REPORT_FILE).stat().st_size < 5_000_000
