"""A calibration that is held, although it is known worse than a reading, is told of."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.held_calibration import (
    expected_errors,
    held_errors,
    held_notes,
    with_calibration_use,
)
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from tests.drives.localised import localised


def drive_with(sigma_C: float, sigma_H: float) -> Drive:
    """Return a drive whose sensors are known so well, by independent errors."""
    drive = localised().solution.drive
    sigma = np.concatenate([np.full(3, 1e-3), np.full(9, sigma_C), np.full(3, sigma_H)])
    count = len(drive.sensors.names)
    covariance = np.tile(np.diag(sigma**2), (count, 1, 1))
    return replace(drive, sensors=replace(drive.sensors, covariance=covariance))


def test_errors_of_readings_are_those_of_drawn_calibrations() -> None:
    drive = drive_with(0.005, 0.3)
    found = held_errors(drive.sensors, drive.readings)
    rng = np.random.default_rng(0)
    for k in range(len(found)):
        C, H = np.split(drive.sensors.distortion[k], [9])
        b = np.linalg.solve(
            C.reshape(3, 3), (drive.readings.field[drive.readings.sensor == k] - H).T
        ).T
        drawn = np.einsum("ni,dji->dnj", b, rng.normal(0, 0.005, (2000, 3, 3)))
        drawn += rng.normal(0, 0.3, (2000, 1, 3))
        # Of 6,000 axes: the rms is found within 1 %.
        assert found[k] == pytest.approx(np.sqrt(np.mean(drawn**2)), rel=0.04)


def test_errors_that_cancel_in_this_field_do_not_count() -> None:
    """C and H are known badly, but what they make of the field that was read is known well."""
    drive = drive_with(0.005, 0.3)
    sensors, readings = drive.sensors, drive.readings
    C, H = np.split(sensors.distortion[0], [9])
    field = np.tile(readings.field[0], (len(readings), 1))
    b = np.linalg.solve(C.reshape(3, 3), field[0] - H)
    root = np.zeros((15, 9))  # errors of C, and of H what undoes them at b
    root[3:12] = 0.01 * np.eye(9)
    root[12:] = -0.01 * np.kron(np.eye(3), b)
    covariance = sensors.covariance.copy()
    covariance[0] = root @ root.T
    known = replace(sensors, covariance=covariance)
    still = replace(readings, field=field)
    assert held_errors(known, still)[0] == pytest.approx(0, abs=1e-6)


def test_a_calibration_known_worse_than_a_reading_is_told_of() -> None:
    (note,) = held_notes(drive_with(0.005, 0.3))
    assert "slam.calibration: refined" in note
    assert held_notes(drive_with(1e-4, 0.01)) == ()


def test_errors_in_a_field_of_any_direction_are_those_of_drawn_calibrations() -> None:
    sensors = drive_with(0.005, 0.3).sensors
    rng, count = np.random.default_rng(1), 20_000
    towards = rng.normal(size=(count, 3))
    b = 50.0 * towards / np.linalg.norm(towards, axis=1)[:, None]
    drawn = np.einsum("nij,nj->ni", rng.normal(0, 0.005, (count, 3, 3)), b)
    drawn += rng.normal(0, 0.3, (count, 3))
    # And 1 mm in 10 uT/m. Of 60,000 axes the rms is found within 0.3 %.
    whole = np.hypot(np.sqrt(np.mean(drawn**2)), 1e-3 * 10.0)
    np.testing.assert_allclose(expected_errors(sensors), whole, rtol=0.015)


@pytest.mark.parametrize(
    ("sigma_C", "sigma_H", "one_field", "use"),
    [
        (5e-3, 0.3, False, CalibrationUse.REFINED),
        (5e-3, 0.3, True, CalibrationUse.FIXED),
        (1e-6, 1e-5, False, CalibrationUse.FIXED),
    ],
)
def test_auto_refines_what_readings_would_show(
    sigma_C: float, sigma_H: float, one_field: bool, use: CalibrationUse
) -> None:
    sensors = drive_with(sigma_C, sigma_H).sensors
    assert with_calibration_use(SlamOptions(), sensors, one_field=one_field).calibration is use
    for given in (CalibrationUse.FIXED, CalibrationUse.REFINED):
        options = SlamOptions(calibration=given)
        assert with_calibration_use(options, sensors, one_field=one_field) == options
