"""Drives of different noise, calibrated together."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.data import Recording
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from tests.drives.degenerate import STRONG
from tests.drives.joint import OPTIONS, made, monday, tuesday
from tests.drives.verdict import NOISE, SENSORS


def noisier(recording: Recording, noise: float, seed: int = 77) -> Recording:
    """Return a drive with more noise, of that much in all, uT."""
    rng, more = np.random.default_rng(seed), np.sqrt(noise**2 - NOISE**2)
    series = tuple(
        replace(each, field=each.field + rng.normal(0, more, each.field.shape))
        for each in recording.series
    )
    return replace(recording, series=series)


def test_a_noisy_drive_beside_a_better_one_takes_nothing_from_it(tmp_path: Path) -> None:
    """Five times the noise: no reading is wrong, and sigmas are those of both drives' information.

    The drives' noise is found to 4 %, and so are sigmas by each of them; the optimum's own
    covariance adds a few hundredths (above).
    """
    first, second = monday(), noisier(tuesday(), 5 * NOISE)
    both = made(first, second)
    result = both.calibrated.result
    assert both.verdict.level is Level.PASS, both.verdict
    assert result.disagreements == ()
    (said,) = [each.text for each in both.verdict.reasons if "Noise differs" in each.text]
    assert "in drives/monday.bag" in said
    one, other = (calibrate(each, STRONG, OPTIONS) for each in (first, second))
    for known in SENSORS:
        found = result[known.sensor]
        # What is beyond the truncated loss by chance is one in ten thousand.
        assert found.rejected <= 1
        np.testing.assert_allclose(found.drive_noise, [NOISE, 5 * NOISE], rtol=0.15)
        away = (found.vector() - known.vector()) / np.sqrt(np.diag(found.covariance))
        assert np.abs(away).max() < 4.5
        weights = [np.linalg.inv(each[known.sensor].covariance) for each in (one, other)]
        expected = np.sqrt(np.diag(np.linalg.inv(weights[0] + weights[1])))
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), expected, rtol=0.12)
    write_calibration(tmp_path / "a.yaml", result)
    back = read_calibration(tmp_path / "a.yaml")
    assert back["mag_0"].drive_noise == result["mag_0"].drive_noise


def test_drives_alike_have_one_noise(tmp_path: Path) -> None:
    """Their file says nothing of it, as before."""
    good = made(monday(), tuesday())
    write_calibration(tmp_path / "a.yaml", good.calibrated.result)
    assert "drive_noise" not in (tmp_path / "a.yaml").read_text()
    assert all("Noise differs" not in each.text for each in good.verdict.reasons)
