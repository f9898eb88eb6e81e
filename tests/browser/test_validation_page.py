"""The page of a validation in a real browser: seen, read, and nothing of a bag runs in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.qa.metrics.changes import compare_calibrations
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.qa.report.validation_page import validation_page
from l2m_gtsam.qa.verdict.validation import judge_validation, validation_thresholds
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.provenance import NamedSource
from l2m_gtsam.records.validation import Validation
from l2m_gtsam.validation.validate import validate
from tests.drives.degenerate import STRONG
from tests.drives.validation import OPTIONS, calibrated, changed, other_drive
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
)

FIGURES = 4 + 3 * 4  # of all sensors and map, and of each sensor


def hostile(calibration: CalibrationResult) -> CalibrationResult:
    """The calibration with names that are markup."""
    sensors = tuple(replace(each, sensor=HOSTILE[each.sensor]) for each in calibration.sensors)
    return replace(calibration, sensors=sensors)


@pytest.fixture(scope="module")
def looked(browser: str, tmp_path_factory: pytest.TempPathFactory) -> Looked:
    """A validation of such sensors, one with a new magnet, beside an older calibration."""
    recording, calibration = other_drive(changed(1, H=np.array([3.0, 0, 0]))), calibrated()
    series = tuple(replace(each, sensor=HOSTILE[each.sensor]) for each in recording.series)
    drive = validate(replace(recording, series=series), STRONG, hostile(calibration), OPTIONS, 1e-3)
    comparison = compare_calibrations(hostile(calibration), hostile(calibration), 1e-3)
    options = QaOptions()
    found = Validation(
        judge_validation(drive, comparison, options),
        drive,
        comparison,
        validation_thresholds(options),
        (NamedSource("drive", BAG, "ab12"),),
        {"l2m-gtsam": "0"},
    )
    folder: Path = tmp_path_factory.mktemp("validation")
    page = folder / "validation.html"
    page.write_text(validation_page(found, Identity("0" * 64)), encoding="utf-8")
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
    for each in looked.looks:
        assert all(name in each["text"] for name in (*HOSTILE.values(), BAG))
        assert each["title"] == "FAIL: validation of 3 magnetometers"
