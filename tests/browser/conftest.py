"""A report whose names come from a hostile bag, and a browser that looks at it."""

import json
import os
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from l2m_gtsam.appraise import appraise
from l2m_gtsam.batch.drives import CALIBRATION_FILE, METRICS_FILE
from l2m_gtsam.batch.reports import REPORT_FILE, report_folder
from l2m_gtsam.calibrate import calibrated
from l2m_gtsam.config import Config
from l2m_gtsam.data import SourceFile
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.metrics_file import write_metrics
from l2m_gtsam.storage.pdf import find_browser
from tests.verdict_drives import NOMINAL, loose

HERE = Path(__file__).parent
TIMEOUT_S = 280
HOSTILE = {
    "mag_0": "<script>alert(1)</script>",
    "mag_1": '"><img src=x onerror=alert(2)>$\\frac{',
    "mag_2": "</style></svg><svg onload=alert(3)>{{ 7 * 7 }}",
}
BAG = "<b onmouseover=alert(4)>drive</b>.bag"


@dataclass(frozen=True)
class Looked:
    """What a browser found: everything that ``look.js`` tells, and the folder of screenshots."""

    looks: list[dict[str, Any]]
    tabbed: list[dict[str, Any]]
    folder: Path


def missing(reason: str) -> None:
    """Skip, or fail where browsers are required."""
    if os.environ.get("L2M_REQUIRE_BROWSER") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def browser() -> str:
    """Path of a browser; node and what `npm ci` installs are there, too."""
    found = find_browser()
    if found is None:
        missing("no chromium: apt-get install chromium")
    if shutil.which("node") is None:
        missing("no node: apt-get install nodejs npm")
    if not (HERE / "node_modules" / "puppeteer-core").is_dir():
        missing("no puppeteer-core: run `npm ci` in tests/browser")
    assert found is not None
    return found


@pytest.fixture(scope="session")
def hostile_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a report on sensors with names that are markup; one of them came loose."""
    folder = tmp_path_factory.mktemp("hostile")
    drive = loose()
    series = tuple(replace(s, sensor=HOSTILE[s.sensor]) for s in drive.recording.series)
    recording = replace(drive.recording, series=series, source=SourceFile(BAG, "ab12"))
    start = {HOSTILE[name]: place for name, place in NOMINAL.items()}
    options = drive.options.model_copy(update={"start": start})
    found = calibrated(recording, drive.field_map, options)
    metrics = appraise(recording, found, options, QaOptions())
    whole = Config(calibration=options).model_dump(mode="json")
    write_calibration(folder / CALIBRATION_FILE, replace(found.result, options=whole))
    write_metrics(folder / METRICS_FILE, metrics)
    report_folder(folder, None)
    return folder


def look(browser: str, page: Path, folder: Path) -> Looked:
    """Open a page on a desk and on a phone, light and dark, and tell what is found."""
    run = subprocess.run(
        ["node", HERE / "look.js", page, folder],  # noqa: S607
        capture_output=True,
        text=True,
        env={**os.environ, "L2M_BROWSER": browser},
        check=False,
        timeout=TIMEOUT_S,
    )
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    return Looked(told["looks"], told["tabbed"], folder)


@pytest.fixture(scope="session")
def looked(browser: str, hostile_report: Path, tmp_path_factory: pytest.TempPathFactory) -> Looked:
    """The hostile report, looked at."""
    return look(browser, hostile_report / REPORT_FILE, tmp_path_factory.mktemp("screenshots"))
