"""Sigmas on a page end at their second digit, wherever they stand."""

import re
from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.calibration_page import calibration_page
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.record_files import read_metrics
from tests.support.repository import REPOSITORY

FILES = REPOSITORY / "tests" / "files"


def test_a_sigma_beside_its_limits_has_the_digits_that_it_has_in_words() -> None:
    known = read_calibration(FILES / "calibration.yaml")
    (sensor,) = known.sensors
    times = 0.187 / sensor.t_sigma.max()
    wide = replace(sensor, covariance=times**2 * sensor.covariance)
    result = replace(known, sensors=(wide,))
    page = calibration_page(result, read_metrics(FILES / "metrics.json"), QaOptions())
    row = re.search(r"sigma of t \(mm\)</th><td>([^<]*)", page)
    assert row is not None
    assert row[1].strip() == "190"
    assert "only known to ± 190 mm" in page


@pytest.mark.parametrize(("first", "level"), [(0, "fail"), (12, "warn")])
def test_what_is_open_is_marked_as_the_verdict_has_it(first: int, level: str) -> None:
    """Without an offset a sensor is still of use, without a place it is not."""
    known = read_calibration(FILES / "calibration.yaml")
    (sensor,) = known.sensors
    covariance = sensor.covariance.copy()
    covariance[first, first] = np.inf
    part = replace(sensor, covariance=covariance, status=SensorStatus.UNDETERMINED)
    result = replace(known, sensors=(part,))
    page = calibration_page(result, read_metrics(FILES / "metrics.json"), QaOptions())
    row = re.search(r'<tr class="(\w+)">(?:(?!<tr).)*not determined', page)
    assert row is not None
    assert row[1] == level
    verdict = judge(result, read_metrics(FILES / "metrics.json"), QaOptions())
    assert verdict.sensors[0].level.value == level
