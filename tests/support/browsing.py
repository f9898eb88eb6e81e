"""A browser that looks at a page, and what every page of ours must be."""

import json
import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from l2m_gtsam.text import shown_lines
from tests.drives.hostile import NAMES
from tests.support.browser_tools import PROGRAMS

TIMEOUT_S = 280
GRAVE = {"serious", "critical"}  # of axe-core
SMALLEST_PX = 9.0  # text in figures; below it labels are not read on a phone


@dataclass(frozen=True)
class Looked:
    """What a browser found: everything that ``look.js`` tells."""

    looks: list[dict[str, Any]]
    tabbed: list[dict[str, Any]]


def told_by(program: str, browser: str, *arguments: str | Path) -> dict[str, Any]:
    """Return what one of our programs for a browser tells."""
    run = subprocess.run(
        ["node", PROGRAMS / program, *arguments],  # noqa: S607 - node is looked up, as a user would
        capture_output=True,
        text=True,
        env={**os.environ, "L2M_BROWSER": browser},
        check=False,
        timeout=TIMEOUT_S,
    )
    assert run.returncode == 0, run.stderr
    told: dict[str, Any] = json.loads(run.stdout)
    return told


def look(browser: str, page: Path, *screenshots: Path) -> Looked:
    """Open a page on a light desk and on a dark phone, and tell what is found.

    Screenshots, which take seconds each, go to a folder if there is one.
    """
    told = told_by("look.js", browser, page, *screenshots)
    return Looked(told["looks"], told["tabbed"])


def check_silence(looked: Looked) -> None:
    """Nothing is reported on the console, and nothing is asked of any address."""
    assert [each["window"] for each in looked.looks] == ["desk", "phone"]
    for each in looked.looks:
        assert each["errors"] == []
        assert each["requests"] == []


def check_figures(looked: Looked, count: int) -> None:
    """So many figures are seen, and drawn."""
    for each in looked.looks:
        assert len(each["figures"]) == count
        for figure in each["figures"]:
            assert figure["alt"]
            assert figure["visible"]
            assert figure["inside"]
            assert figure["drawn"] > 5
            assert min(figure["width"], figure["height"]) > 100
            assert figure["hovered"] is not False


def drawn_figures(page: Path) -> list[int]:
    """Return how many parts are drawn in each figure of a page, without looking at it."""
    figures = re.findall(r"<figure.*?</figure>", page.read_text(encoding="utf-8"), re.DOTALL)
    return [len(re.findall("<(?:path|image|use) ", each)) for each in figures]


def check_values(looked: Looked) -> None:
    """Every figure shows values where the pointer is."""
    for each in looked.looks:
        assert [figure["alt"] for figure in each["figures"] if not figure["values"]] == []


def check_phone(looked: Looked) -> None:
    """Nothing is wider than the screen or too small to be read."""
    for each in looked.looks:
        assert not each["wider"]
        assert each["smallest_text"] >= SMALLEST_PX


def check_accessibility(looked: Looked) -> None:
    """Axe-core has no serious finding."""
    for each in looked.looks:
        assert [fault for fault in each["accessibility"] if fault["impact"] in GRAVE] == []


def missing_names(text: str) -> list[str]:
    """Return which of twenty hostile names cannot be read in the text of a page."""
    seen = _plain(text)
    return [name for name in NAMES[:-1] if _plain(shown_lines(name)) not in seen]


def _plain(text: str) -> str:
    # what stands in backticks is code, without them
    return "".join(text.replace("`", "").split())


HOSTILE = {
    "mag_0": "<script>alert(1)</script>",
    "mag_1": '"><img src=x onerror=alert(2)>$\\frac{',
    "mag_2": "</style></svg><svg onload=alert(3)>{{ 7 * 7 }}",
}


BAG = "<b onmouseover=alert(4)>drive</b>.bag"
