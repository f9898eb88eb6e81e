"""Pages with twenty names that are code, in a real browser: all are text, and nothing runs."""

from pathlib import Path

import pytest

from l2m_gtsam.qa.fleet import with_outliers
from l2m_gtsam.qa.options import FleetOptions, QaOptions
from l2m_gtsam.qa.report.fleet_page import fleet_page
from l2m_gtsam.qa.report.localisation_page import localisation_page
from l2m_gtsam.text.shown import shown_lines
from tests.drives.hostile import NAMES, fleet_rows, localisation
from tests.support.browsing import check_accessibility, check_silence, look

PAGES = {
    "fleet": lambda: fleet_page(with_outliers(fleet_rows(), FleetOptions()), FleetOptions()),
    "localisation": lambda: localisation_page(localisation(), QaOptions()),
}


@pytest.mark.parametrize("kind", PAGES)
def test_names_are_text(browser: str, tmp_path: Path, kind: str) -> None:
    page = tmp_path / "page.html"
    page.write_text(PAGES[kind](), encoding="utf-8")
    looked = look(browser, page, tmp_path)
    check_silence(looked)
    check_accessibility(looked)
    for each in looked.looks:
        text = "".join(each["text"].replace("`", "").split())
        for name in NAMES[:-1]:
            # What stands in backticks is code, without them.
            assert "".join(shown_lines(name).replace("`", "").split()) in text, name
