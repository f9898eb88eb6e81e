"""Path that counts for learning a field: that over which there are readings."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.read_path import path_with_readings
from tests.drives.slam import calibrated, small_hall


def path_where(kept: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the path of a drive with all readings, and with those between some lengths, m."""
    sensors, recorded = small_hall(5, seconds=20)
    drive, _ = prepared(recorded.recording, calibrated(sensors), SlamOptions())
    at = drive.steps.path[drive.readings.key_pose]
    rows = np.flatnonzero((at >= kept[0]) & (at < kept[1]))
    less = replace(drive, readings=drive.readings[rows], reading_ns=drive.reading_ns[rows])
    return drive.steps.path, path_with_readings(less)


def test_with_readings_all_along_it_is_the_path() -> None:
    whole, read = path_where(np.array([0.0, np.inf]))
    np.testing.assert_array_equal(read, whole)


def test_all_but_a_metre_of_what_is_silent_is_left_out() -> None:
    whole, read = path_where(np.array([5.0, 8.0]))
    assert abs(read[np.searchsorted(whole, 4.5)] - 1.0) < 0.3
    assert abs(read[-1] - (1.0 + 3.0 + 1.0)) < 0.6
    assert np.all(np.diff(read) >= 0)
