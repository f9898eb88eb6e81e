"""Readings that no steel explains are told from those that steel may explain."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import FieldSeries, FloatArray, Readings, Recording, SourceFile, Trajectory
from l2m_gtsam.maps.harmonic.dipoles import moment_features
from l2m_gtsam.recording.spikes import spikes, without_spikes

NOISE_UT = 0.1
NEAREST_M = 0.2
STEP_M = 0.05


def along_a_line(count: int, step_m: float) -> Readings:
    """Return readings of nothing of two sensors, one after the other, on a straight path."""
    x = step_m * np.arange(count)
    p = np.tile(np.column_stack([x, np.zeros((count, 2))]), (2, 1))
    stamps = np.tile(np.arange(count) * 100_000_000, 2)
    R = np.broadcast_to(np.eye(3), (2 * count, 3, 3))
    sensor = np.repeat([0, 1], count)
    return Readings(("a", "b"), sensor, stamps, R, p, np.zeros((2 * count, 3)))


def shown(readings: Readings, lacking: FloatArray) -> list[int]:
    noise = np.full(len(readings), NOISE_UT)
    moved = np.linalg.norm(np.diff(readings.p_map_lidar, axis=0), axis=1)
    return np.flatnonzero(spikes(readings.sensor, moved, lacking, noise, NEAREST_M)).tolist()


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


def recorded(field: FloatArray, step_m: float) -> Recording:
    """Return a recording of one sensor on a straight path."""
    count = len(field)
    p = np.column_stack([step_m * np.arange(count), np.zeros((count, 2))])
    stamps = np.arange(count) * 50_000_000
    poses = Trajectory(stamps, np.tile(np.eye(3), (count, 1, 1)), p, "map", "lidar")
    series = FieldSeries("a", "/a", "a", stamps, field)
    return Recording(poses, (series,), SourceFile("drive", ""))


def passing_steel(count: int, step_m: float) -> FloatArray:
    """Return the field of a dipole 30 cm beside the middle of a path, 40 uT at most, with noise."""
    x = step_m * (np.arange(count) - count / 2)
    points = np.column_stack([x, np.full(count, 0.3), np.zeros(count)])
    steel = moment_features(points, np.zeros((1, 3))) @ np.array([0.0, 0.0, 1.0])
    noise = NOISE_UT * np.random.default_rng(5).standard_normal((count, 3))
    return np.asarray(40.0 * steel / np.abs(steel).max() + noise)


def test_spikes_of_a_recording_are_left_out_and_steel_is_not() -> None:
    sound = passing_steel(400, 0.035)
    whole = recorded(sound, 0.035)
    same, shares = without_spikes(whole, 0.5)
    assert same is whole
    assert shares == [0.0]
    wrong = sound.copy()
    at = [30, 200, 300, 301]  # in a calm place, beside the steel, and two in a row
    wrong[at] += [[20.0, 0.0, 0.0], [0.0, -30.0, 0.0], [0.0, 0.0, 15.0], [12.0, -9.0, 0.0]]
    found, shares = without_spikes(recorded(wrong, 0.035), 0.5)
    assert shares == [0.01]
    np.testing.assert_array_equal(found.series[0].field, np.delete(sound, at, axis=0))


def test_digits_of_a_sensor_at_rest_are_no_spikes() -> None:
    """Where nearly all readings are the same their scatter is none."""
    field = np.full((300, 3), 20.0)
    field[::20, 0] += 0.15
    _, shares = without_spikes(recorded(field, 0.0), 0.5)
    assert shares == [0.0]
