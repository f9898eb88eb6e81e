"""The report in a real browser: seen, read, tabbed through, and nothing of a bag runs in it."""

import re
from pathlib import Path

import numpy as np
from PIL import Image

from l2m_gtsam.batch.reports import PDF_FILE, REPORT_FILE
from tests.support.browsing import (
    BAG,
    HOSTILE,
    Looked,
    check_accessibility,
    check_figures,
    check_phone,
    check_silence,
    check_values,
)
from tests.support.repository import REPOSITORY

FIGURES = 4 + 3 * 8  # of vehicle and map, and of each sensor
# A figure that failed to draw is a blank card: of one that is drawn at least this share differs
# from its background.
INKED = 0.01


def test_nothing_is_reported_on_the_console_or_loaded(looked: Looked) -> None:
    check_silence(looked)


def test_no_style_depends_on_width_and_scheme() -> None:
    """Else a light desk and a dark phone would not show all that there is."""
    queries = [
        query
        for path in (REPOSITORY / "l2m_gtsam" / "qa" / "report" / "templates").glob("*.css")
        for query in re.findall(r"@media[^{]*", path.read_text(encoding="utf-8"))
    ]
    assert any("prefers-color-scheme" in each for each in queries)
    assert not [each for each in queries if "prefers-color-scheme" in each and "width" in each]


def test_every_figure_is_seen(looked: Looked) -> None:
    check_figures(looked, FIGURES)


def test_it_fits_a_phone(looked: Looked) -> None:
    check_phone(looked)


def test_no_card_is_cut_off(looked: Looked) -> None:
    assert [each["cut"] for each in looked.looks] == [[]] * 2


def test_light_and_dark_differ(looked: Looked, screenshots: Path) -> None:
    assert looked.looks
    light, dark = (
        np.asarray(Image.open(screenshots / f"{name}.png").convert("L"))[::4, ::4].astype(float)
        for name in ("desk", "phone")
    )
    assert np.median(light) > 200
    assert np.median(dark) < 60
    for picture in (light, dark):
        assert np.mean(np.abs(picture - np.median(picture)) > 40) > INKED


def test_every_figure_has_values_under_the_pointer(looked: Looked) -> None:
    check_values(looked)


def test_accessibility_has_no_grave_fault(looked: Looked) -> None:
    check_accessibility(looked)


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
    content = (hostile_report / PDF_FILE).read_bytes()
    assert content.startswith(b"%PDF")
    # Two or three pages on the whole, one or two for each of three sensors (long reasons), three on
    # where it came from and by which options.
    assert 8 <= len(re.findall(rb"/Type /Page\b", content)) <= 12
    assert (hostile_report / REPORT_FILE).stat().st_size < 5_000_000
