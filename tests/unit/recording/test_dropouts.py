"""Sensors that die during a drive."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.data import FieldSeries, FloatArray, IntArray, Recording
from l2m_gtsam.recording.dropouts import is_dead, mask_dropouts
from tests.drives.slam import rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

RECORDING = slam_drive(
    dipole_world(1), random_sensors(1, 2), rounds(30), np.random.default_rng(1)
).recording


def changed(field: FloatArray) -> Recording:
    """Return the drive with other readings of the first sensor."""
    first, second = RECORDING.series
    return replace(RECORDING, series=(replace(first, field=field), second))


def dead(series: FieldSeries) -> IntArray:
    return np.flatnonzero(~np.isfinite(series.field).all(axis=1))


def test_a_drive_of_live_sensors_stays_as_it_is() -> None:
    found = mask_dropouts(RECORDING)
    assert found.notes == ()
    for before, after in zip(RECORDING.series, found.recording.series, strict=True):
        np.testing.assert_array_equal(before.field, after.field)


@pytest.mark.parametrize("value", [None, 0.0, np.nan])
def test_a_sensor_that_dies_is_silent_from_then_on(value: float | None) -> None:
    """On its last value, on zeros, on NaN: half of the 30 s."""
    field = RECORDING.series[0].field.copy()
    field[300:] = field[299] if value is None else value
    found = mask_dropouts(changed(field))
    first, second = found.recording.series
    start = 299 if value is None else 300
    np.testing.assert_array_equal(dead(first), np.arange(start, len(field)))
    assert len(dead(second)) == 0
    (note,) = found.notes
    assert note.startswith("mag_00 is dead for 50% of the drive, longest from ")
    assert not is_dead(first)


def test_a_sensor_that_never_lived_is_dead() -> None:
    found = mask_dropouts(changed(np.full_like(RECORDING.series[0].field, 3.0)))
    assert is_dead(found.recording.series[0])
    assert not is_dead(found.recording.series[1])
    assert found.notes == ()  # whoever leaves it out says so


def test_a_parked_vehicle_may_read_one_value() -> None:
    """A coarse sensor at rest is not stuck."""
    odometry, field = RECORDING.trajectory, RECORDING.series[0].field.copy()
    R, p = odometry.R.copy(), odometry.p.copy()
    R[300:500], p[300:500], field[300:498] = R[300], p[300], field[300]
    parked = replace(changed(field), trajectory=replace(odometry, R=R, p=p))
    assert len(dead(mask_dropouts(parked).recording.series[0])) == 0


def test_a_sensor_that_comes_back_lives() -> None:
    field = RECORDING.series[0].field.copy()
    field[100:150] = 0.0
    field[400:420] = 0.0
    found = mask_dropouts(changed(field))
    assert len(dead(found.recording.series[0])) == 70
    assert found.notes == ()  # of less than five seconds nobody is told
