"""What a drive without a map says of the noise that calibrations state."""

import numpy as np
import pytest

from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.exploration import MISSTATED, NoiseNotes, noise_notes
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise

STATED = 0.2


def sensors(count: int) -> KnownSensors:
    return KnownSensors(
        names=tuple(f"mag_{k:02d}" for k in range(count)),
        t=np.zeros((count, 3)),
        distortion=np.zeros((count, 12)),
        offset=np.zeros(count),
        noise=np.full(count, STATED),
        covariance=np.zeros((count, 15, 15)),
    )


def notes(ut: float) -> NoiseNotes:
    return noise_notes(SensorNoise(ut, 1.0, 0.0), sensors(2))


@pytest.mark.parametrize("times", [1.1 / MISSTATED, 1.0, 0.9 * MISSTATED])
def test_noise_about_as_stated_is_not_mentioned(times: float) -> None:
    assert notes(times * STATED) == NoiseNotes()


def test_noise_stated_too_small_is_a_warning() -> None:
    (text,) = notes(5 * STATED).warnings
    assert "off by 1 uT each, by the drive itself; their calibrations state 0.2 uT" in text
    assert "the noise is stated too small, or calibrations are off" in text
    assert not notes(5 * STATED).hints


def test_noise_stated_too_large_is_a_hint() -> None:
    (text,) = notes(STATED / 4).hints
    assert "off by 0.05 uT each" in text
    assert "poses would be known better" in text
    assert not notes(STATED / 4).warnings


def test_what_is_given_is_not_doubted() -> None:
    assert noise_notes(None, sensors(2)) == NoiseNotes()


def test_of_one_sensor_noise_that_lasts_is_told_as_well() -> None:
    (text,) = noise_notes(SensorNoise(5.0, 0.36, 2.0), sensors(1)).warnings
    assert "readings of mag_00 are off by 3 uT each and by 4 uT that last over 2 m of path" in text
