"""A browser and what tells it what to do: found, or a test is skipped."""

import os
import shutil
from pathlib import Path

import pytest

from l2m_gtsam.batch.printing import find_browser

PROGRAMS = Path(__file__).parents[1] / "browser"


def find_tools() -> str:
    """Return the path of a browser; node and what `npm ci` installs are there, too."""
    found = find_browser()
    if found is None:
        missing("no chromium: apt-get install chromium")
    if shutil.which("node") is None:
        missing("no node: apt-get install nodejs npm")
    if not (PROGRAMS / "node_modules" / "puppeteer-core").is_dir():
        missing("no puppeteer-core: run `npm ci` in tests/browser")
    assert found is not None
    return found


def missing(reason: str) -> None:
    """Skip, or fail where browsers are required."""
    if os.environ.get("L2M_REQUIRE_BROWSER") == "1":
        pytest.fail(reason)
    pytest.skip(reason)
