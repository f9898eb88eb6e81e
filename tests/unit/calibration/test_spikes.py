"""Readings that no steel explains are told from those that steel may explain."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.averages import spikes
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.harmonic.dipoles import moment_features

NOISE_UT = 0.1
NEAREST_M = 0.2
STEP_M = 0.05


def along_a_line(count: int, step_m: float) -> Readings:
    """Return readings of nothing of two sensors, one after the other, on a straight way."""
    x = step_m * np.arange(count)
    p = np.tile(np.column_stack([x, np.zeros((count, 2))]), (2, 1))
    stamps = np.tile(np.arange(count) * 100_000_000, 2)
    R = np.broadcast_to(np.eye(3), (2 * count, 3, 3))
    sensor = np.repeat([0, 1], count)
    return Readings(("a", "b"), sensor, stamps, R, p, np.zeros((2 * count, 3)))


def shown(readings: Readings, lacking: FloatArray) -> list[int]:
    ideal = np.tile(np.append(np.eye(3).ravel(), np.zeros(3)), (2, 1))
    estimate = Estimate(np.zeros((2, 3)), ideal, np.full(2, NOISE_UT), np.zeros(2), np.zeros(2))
    return np.flatnonzero(spikes(readings, lacking, estimate, NEAREST_M)).tolist()


def test_single_spikes_are_found_also_at_the_ends() -> None:
    readings, rng = along_a_line(30, STEP_M), np.random.default_rng(3)
    lacking = NOISE_UT * rng.standard_normal((60, 3))
    for at in (0, 12, 29, 40):
        lacking[at] += [0.0, 6.0, 0.0]
    assert shown(readings, lacking) == [0, 12, 29, 40]


def test_what_lasts_over_several_readings_is_no_spike() -> None:
    readings = along_a_line(30, STEP_M)
    lacking = np.zeros((60, 3))
    lacking[10:13] += 6.0
    lacking[15:30] += 2.0
    assert shown(readings, lacking) == []


@given(
    st.floats(0.0, 1.5),
    st.floats(0.0, 2 * np.pi),
    st.floats(NEAREST_M, 2.0),  # of the way, no nearer than steel is
    st.floats(0.01, 0.5),
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
)
def test_a_dipole_is_never_a_spike(
    x: float, angle: float, away: float, step: float, moment: list[float]
) -> None:
    readings = along_a_line(30, step)
    place = np.array([[x, away * np.cos(angle), away * np.sin(angle)]])
    field = 1e3 * moment_features(readings.p_map_lidar, place) @ np.array(moment)
    assert shown(readings, field) == []


def test_noise_is_no_spike() -> None:
    readings, rng = along_a_line(500, STEP_M), np.random.default_rng(4)
    lacking = NOISE_UT * rng.standard_normal((1000, 3))
    assert shown(readings, lacking) == []
    still = replace(readings, p_map_lidar=np.zeros((1000, 3)))
    assert shown(still, lacking) == []
