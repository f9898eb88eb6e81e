"""The documentation as a site: built strictly, complete, readable without a network."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

from l2m_gtsam.config import Config
from tests.support.repository import REPOSITORY


class Page(HTMLParser):
    """What a page of the site fetches."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag in ("script", "img", "iframe", "source"):
            self.fetched.append(found.get("src") or "")
        if tag == "link" and found.get("rel") not in ("canonical", "prev", "next"):
            self.fetched.append(found.get("href") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built strictly: a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NO_MKDOCS_2_WARNING", "1")
        patch.chdir(REPOSITORY)
        build(load_config(str(REPOSITORY / "mkdocs.yml"), site_dir=str(folder), strict=True))
    return folder


def test_the_site_needs_no_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for path in pages:
        page = Page()
        page.feed(path.read_text(encoding="utf-8"))
        assert not [each for each in page.fetched if re.match(r"(https?:)?//", each)], path
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def test_every_option_is_on_its_page(site: Path) -> None:
    """With the default of its place: the mapping thins more than the class of its options does."""
    page = (site / "reference" / "configuration.html").read_text(encoding="utf-8")
    for key in ("mapping.sync", "calibration.solve.robust", "calibration.priors.array.baselines[]"):
        assert f'id="{key}"' in page
    default = Config().mapping.sync.thin_distance_m
    row = page[page.index("thin_distance_m", page.index('id="mapping.sync"')) :][:400]
    assert f"<code>{default:g}</code>" in row


def test_the_reference_has_what_people_call(site: Path) -> None:
    inside = "".join(p.read_text(encoding="utf-8") for p in (site / "reference").glob("*.html"))
    for name in (
        "l2m_gtsam.planning.plan.plan",
        "l2m_gtsam.records.calibration.SensorCalibration",
        "l2m_gtsam.maps.harmonic.harmonic_map.HarmonicMap",
        "l2m_gtsam.batch.drives.calibrate_bags",
        "l2m_factors.reading.reading_factor",
    ):
        assert f'id="{name}"' in inside
