"""What is wider than a desk: nothing of the fleet's table, and no name in the navigation."""

import re
import subprocess
from dataclasses import replace
from pathlib import Path

from l2m_gtsam.batch.printing import find_browser
from l2m_gtsam.qa.options import FleetOptions, QaOptions
from l2m_gtsam.qa.report.calibration_page import calibration_page
from l2m_gtsam.qa.report.fleet_page import fleet_page
from l2m_gtsam.records.fleet import Outlier
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.record_files import read_metrics
from tests.drives.fleet_rows import row, sensor_row
from tests.support.browser_tools import missing
from tests.support.repository import REPOSITORY

DESK = 1280  # pixels
REASON = (
    "Steel 1 came, went or was moved since the map was surveyed: at (1.152, 2.982, 0.985) ± 0.094 "
    "m, 0.22 ± 0.13 A m², up to 1.6 µT at the readings. It is taken into account."
)


def measured(page: str, expression: str, folder: Path) -> list[int]:
    """Return what a browser finds on a page, whole numbers of pixels."""
    browser = find_browser()
    if browser is None:
        missing("no chromium: apt-get install chromium")
    assert browser is not None
    # the page's own policy lets no script of others run
    free = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    path = folder / "page.html"
    path.write_text(f"{free}<script>document.title = [{expression}].join()</script>")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += [f"--user-data-dir={folder}", f"--window-size={DESK},900", path.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    found = re.search("<title>([^<]*)</title>", dom)
    assert found is not None
    return [round(float(each)) for each in found[1].split(",")]


def test_the_table_of_a_fleet_fits_a_desk(tmp_path: Path) -> None:
    """With outliers and a reason, which wrap."""
    off = (Outlier("t_z (mm)", 63.1, 12.3), Outlier("H_x (µT)", 0.61, 5.3))
    judged = sensor_row("mag_00", verdict="warn", reason=REASON)
    rows = [replace(row(day, judged), outliers=off) for day in range(3)]
    table = "document.querySelector('.sortable')"
    found = measured(
        fleet_page(rows, FleetOptions()),
        f"{table}.scrollWidth, {table}.parentNode.clientWidth",
        tmp_path,
    )
    assert found[0] <= found[1]


def test_all_sensors_are_in_the_navigation(tmp_path: Path) -> None:
    files = REPOSITORY / "tests" / "files"
    one = read_calibration(files / "calibration.yaml")
    sensors = tuple(replace(one.sensors[0], sensor=f"mag_{k:02d}") for k in range(12))
    page = calibration_page(
        replace(one, sensors=sensors), read_metrics(files / "metrics.json"), QaOptions()
    )
    links = "...[...document.querySelectorAll('nav a')].map((a) => a.getBoundingClientRect().right)"
    found = measured(page, links, tmp_path)
    assert len(found) >= 12
    assert max(found) <= DESK
