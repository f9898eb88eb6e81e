"""Digits of the page: a value ends where its standard deviation does, and none has an exponent."""

import re
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.calibration_page import calibration_page
from l2m_gtsam.qa.report.page import roll_pitch_yaw, roll_pitch_yaw_sigma
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.record_files import read_metrics
from tests.support.repository import REPOSITORY

FILES = REPOSITORY / "tests" / "files"
NUMBER = r"[+-]?[0-9.]+(?:e[+-]\d+)?"


def page() -> str:
    """Return the page of a calibration of one sensor whose sigmas span five decades."""
    result, metrics = (
        read_calibration(FILES / "calibration.yaml"),
        read_metrics(FILES / "metrics.json"),
    )
    (sensor,) = result.sensors
    sigmas = np.geomspace(2e-4, 20, 15)
    wide = replace(sensor, covariance=np.diag(sigmas**2))
    return calibration_page(replace(result, sensors=(wide,)), metrics, QaOptions())


def decimals(number: str) -> int:
    return len(number.partition(".")[2])


def test_values_and_sigmas_end_at_the_same_decimal() -> None:
    text = page().replace("\xa0", " ")
    pairs = re.findall(rf"({NUMBER}) ± ({NUMBER})", text)
    cells = re.findall(rf"\((?:m|1|µT)\)</th><td>({NUMBER})</td><td>({NUMBER})</td>", text)
    assert len(pairs) >= 6
    assert len(cells) == 15
    for value, sigma in pairs + cells:
        assert "e" not in sigma
        assert decimals(value) == decimals(sigma)
        # two digits, of which the first is not zero
        assert len(sigma.replace(".", "").lstrip("0")) == 2


def test_angles_have_their_own_sigmas() -> None:
    """Against errors that are drawn; the sensor is turned so that its z axis is the lidar's x."""
    turn = Rotation.from_euler("ZYX", [20, 30, 90], degrees=True)
    covariance = np.diag(np.deg2rad([0.3, 0.1, 0.02]) ** 2)
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(3), covariance, 4000)
    drawn = [roll_pitch_yaw(turn * Rotation.from_rotvec(each)) for each in errors]
    found = roll_pitch_yaw_sigma(turn, covariance)
    # of 4000 the standard deviation is known to 1 %
    np.testing.assert_allclose(np.std(drawn, axis=0), found, rtol=0.05)
    open_about_z = np.diag([1e-6, 1e-6, np.inf])
    assert np.isinf(roll_pitch_yaw_sigma(turn, open_about_z)).all()
