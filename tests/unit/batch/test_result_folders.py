"""Folders of results: a calibration and a localisation do not replace each other's reports."""

from pathlib import Path

import pytest

from l2m_gtsam.batch.reports import SLAM_FILE, calibration_results
from l2m_gtsam.errors import OutputError


def test_a_calibration_does_not_replace_a_localisation(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    for name in (SLAM_FILE, page.name):
        (tmp_path / name).write_text("{}")
    told = "holds a localisation, whose report would be lost; choose another --out"
    with pytest.raises(OutputError, match=told), calibration_results(tmp_path) as stage:
        (stage / page.name).write_text("another")
    assert page.read_text() == "{}"
