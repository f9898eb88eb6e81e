"""A field that is the same everywhere shows no place, whatever sigmas a map's gradient gives."""

import numpy as np
import pytest

from l2m_gtsam.calibration.explanation import is_noise, shows_no_place
from l2m_gtsam.data import Readings
from tests.drives.degenerate import COUNT, STRONG
from tests.drives.verdict import EIGHT, SENSORS, read
from tests.worlds.exact import DipoleWorld, dipole_world

SENSOR = SENSORS[0]


def weakened(share: float) -> DipoleWorld:
    """The strong field with so much of what its sources add."""
    return DipoleWorld(STRONG.uniform, STRONG.positions, share * STRONG.moments)


def readings(place: DipoleWorld) -> Readings:
    series = read(SENSOR, EIGHT, place, np.random.default_rng(3))
    return Readings(
        (SENSOR.sensor,),
        np.zeros(COUNT, dtype=np.int64),
        EIGHT.stamp_ns,
        EIGHT.R,
        EIGHT.p,
        series.field,
    )


@pytest.mark.parametrize(("share", "even"), [(0.0, True), (0.003, True), (0.1, False), (1, False)])
def test_readings_show_a_place_where_the_field_varies(share: float, even: bool) -> None:
    place = weakened(share)
    assert shows_no_place(readings(place), place, SENSOR.t_lidar_mag) is even


def test_a_map_of_another_place_is_not_taken_for_an_even_field() -> None:
    """A field that is the same everywhere leaves as much as that map, but no noise."""
    assert not shows_no_place(readings(STRONG), dipole_world(77, 15), SENSOR.t_lidar_mag)


def test_noise_is_told_from_what_lasts() -> None:
    noise = np.random.default_rng(0).normal(size=(500, 3))
    assert is_noise(noise)
    assert not is_noise(noise[:-1] + noise[1:])
