"""A report whose names come from a hostile bag, and a browser that looks at it."""

from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.batch.drives import CALIBRATION_FILE, METRICS_FILE
from l2m_gtsam.batch.reports import REPORT_FILE, report_folder
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.config import Config
from l2m_gtsam.data import SourceFile
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.record_files import write_metrics
from tests.drives.verdict import NOMINAL, loose
from tests.support.browsing import BAG, HOSTILE, Looked, look


@pytest.fixture(scope="session")
def hostile_report(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a printed report on sensors with names that are markup; one came loose."""
    assert browser
    folder = tmp_path_factory.mktemp("hostile")
    drive = loose()
    series = tuple(replace(s, sensor=HOSTILE[s.sensor]) for s in drive.recording.series)
    recording = replace(drive.recording, series=series, source=SourceFile(BAG, "ab12"))
    start = {HOSTILE[name]: place for name, place in NOMINAL.items()}
    options = drive.options.model_copy(update={"start": start})
    found = calibrated(recording, drive.field_map, options)
    metrics = evaluate(recording, found, options, QaOptions())
    whole = Config(calibration=options).model_dump(mode="json")
    write_calibration(folder / CALIBRATION_FILE, replace(found.result, options=whole))
    write_metrics(folder / METRICS_FILE, metrics)
    report_folder(folder, None, pdf=True)
    return folder


@pytest.fixture(scope="session")
def screenshots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the screenshots of the hostile report."""
    return tmp_path_factory.mktemp("screenshots")


@pytest.fixture(scope="session")
def looked(browser: str, hostile_report: Path, screenshots: Path) -> Looked:
    """The hostile report, looked at."""
    return look(browser, hostile_report / REPORT_FILE, screenshots)
