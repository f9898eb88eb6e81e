"""Readings beyond a sensor's range, by the readings alone; and what is no limit of a range."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.calibrate import prepare
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FloatArray, SaturatedAxis, SourceFile
from l2m_gtsam.recording.dropouts import mask_dropouts
from l2m_gtsam.recording.joining import joined
from l2m_gtsam.recording.saturation import (
    is_saturated,
    limits_together,
    saturated_axes,
    saturation_sentence,
)
from l2m_gtsam.recording.sync import SyncOptions, synchronise
from tests.drives.slam import rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

SEEDS = st.integers(0, 10_000)
STEPS = st.sampled_from([0.1, 0.15, 0.2, 0.3, 0.5])
RECORDING = slam_drive(
    dipole_world(1), random_sensors(1, 2), rounds(60), np.random.default_rng(1)
).recording


def level_rounds(seed: int, noise: float, steel: float) -> FloatArray:
    """Readings in uT of a level vehicle on aisles and turns, past steel of such a field."""
    rng, n = np.random.default_rng(seed), 400
    t, ends = np.linspace(0, 1, n), np.linspace(0, 1, 12)
    heading = np.interp(t, ends, np.repeat(np.cumsum(rng.integers(-1, 2, 6)) * np.pi / 2, 2))
    field = np.column_stack([20 * np.cos(heading), -20 * np.sin(heading), np.full(n, -40.0)])
    for at, size in zip(rng.uniform(0, 1, 30), rng.normal(0, steel, (30, 3)), strict=True):
        field += np.exp(-(((t[:, None] - at) / 0.02) ** 2)) * size
    return field + rng.normal(0, 15, 3) + rng.normal(0, noise, field.shape)


def in_steps(field: FloatArray, step: float) -> FloatArray:
    return np.asarray(np.round(field / step) * step)


@given(SEEDS, st.floats(0.02, 0.4))
def test_a_clipped_axis_is_found_with_its_limit_and_its_share(seed: int, share: float) -> None:
    field = level_rounds(seed, 0.1, 8.0)
    limit = float(np.quantile(field[:, 1], 1 - share))
    clipped = np.minimum(field, [np.inf, limit, np.inf])
    expected = int(np.sum(field[:, 1] >= limit))
    assert saturated_axes(clipped) == (SaturatedAxis("y", limit, expected, len(field)),)
    np.testing.assert_array_equal(
        is_saturated(clipped, saturated_axes(clipped)), field[:, 1] >= limit
    )


@given(SEEDS, st.floats(0.1, 0.4))
def test_axes_that_are_clipped_together_are_all_found(seed: int, share: float) -> None:
    field = level_rounds(seed, 0.1, 20.0)
    low, high = np.quantile(field, [share, 1 - share], axis=0)
    found = saturated_axes(np.clip(field, low, high))
    assert [each.axis for each in found] == ["x", "x", "y", "y", "z", "z"]


@given(SEEDS, st.sampled_from([0.05, 0.1]))
def test_so_is_one_whose_digits_are_coarse_where_the_field_varies(seed: int, step: float) -> None:
    field = in_steps(level_rounds(seed, 0.1, 20.0), step)
    limit = float(np.quantile(field[:, 1], 0.2, method="nearest"))
    found = saturated_axes(np.maximum(field, [-np.inf, limit, -np.inf]))
    assert ("y", limit) in [(each.axis, each.limit) for each in found]


@given(SEEDS, STEPS, st.floats(0.1, 0.5), st.sampled_from([0.0, 1.0, 8.0]))
def test_coarse_digits_are_no_limit(seed: int, step: float, noise: float, steel: float) -> None:
    """In a calm field readings tie along whole aisles; there the other axes do, too."""
    assert saturated_axes(in_steps(level_rounds(seed, noise, steel), step)) == ()


@given(SEEDS, STEPS, st.floats(0.01, 0.5))
def test_a_sensor_at_rest_has_no_limit(seed: int, step: float, noise: float) -> None:
    rng = np.random.default_rng(seed)
    field = rng.normal(0, 30, 3) + rng.normal(0, noise, (500, 3))
    assert saturated_axes(in_steps(field, step)) == ()
    assert saturated_axes(field) == ()


@given(SEEDS, STEPS)
def test_a_slow_turn_on_the_spot_has_no_limit(seed: int, step: float) -> None:
    """A sine stays near its extreme: within d of it for a time that goes as sqrt(d)."""
    angle = np.linspace(0, 2 * np.pi, 2000) + np.random.default_rng(seed).uniform(0, 7)
    field = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), 10 * np.cos(2 * angle)])
    assert saturated_axes(in_steps(field, step)) == ()
    assert saturated_axes(field) == ()


def test_few_readings_and_constant_axes_have_no_limit() -> None:
    assert saturated_axes(np.empty((0, 3))) == ()
    assert saturated_axes(np.ones((1, 3))) == ()
    assert saturated_axes(np.tile([1.0, 2.0, 3.0], (100, 1))) == ()


@pytest.mark.parametrize("step", [0.0, 0.1, 0.2, 0.3, 0.5])
@pytest.mark.parametrize("every", [1, 20])
def test_recorded_sensors_have_no_limit(shared_data: Path, step: float, every: int) -> None:
    fields = []
    with np.load(shared_data / "optitrack_handheld_2runs.npz") as data:
        fields.append(data["mag_uT"])
    with np.load(shared_data / "aalto_robot_runs1-4.npz") as data:
        fields += list(data["mag_body"].transpose(1, 0, 2))
    with np.load(shared_data / "model_ship_runs1-2.npz") as data:
        fields += [50 * data["field_1"], 50 * data["field_2"]]  # about the Earth's strength
    for field in fields:
        finite = field[np.isfinite(field).all(axis=1)][::every]
        assert saturated_axes(in_steps(finite, step) if step else finite) == ()


def clipped_drive(share: float) -> tuple[float, FloatArray]:
    """Return a limit of x of the first sensor, and its readings with that."""
    field = RECORDING.series[0].field
    limit = float(np.quantile(field[:, 0], 1 - share))
    return limit, np.minimum(field, [limit, np.inf, np.inf])


def test_readings_beyond_the_range_do_not_count() -> None:
    limit, field = clipped_drive(0.2)
    first, second = RECORDING.series
    recording = replace(RECORDING, series=(replace(first, field=field), second))
    found, whole = (synchronise(each, SyncOptions()) for each in (recording, RECORDING))
    clipped, other = found.counts
    (found_limit,) = clipped.limits
    assert (found_limit.axis, found_limit.limit) == ("x", limit)
    assert found_limit.of == whole.counts[0].kept
    assert other == whole.counts[1]
    assert clipped.saturated == np.sum(field[:, 0] == limit)
    assert clipped.received == sum(
        (clipped.saturated, clipped.thinned, clipped.kept, clipped.outside_trajectory)
    )
    own = found.readings.field[found.readings.rows_of(0)]
    assert own[:, 0].max() < limit


def test_limits_are_those_of_all_drives() -> None:
    _, field = clipped_drive(0.2)
    first, second = RECORDING.series
    clipped = replace(RECORDING, series=(replace(first, field=field), second))
    later = replace(
        RECORDING.trajectory, stamp_ns=RECORDING.trajectory.stamp_ns + 10**12, covariance=None
    )
    series = tuple(replace(s, stamp_ns=s.stamp_ns + 10**12) for s in RECORDING.series)
    sound = replace(RECORDING, trajectory=later, series=series, source=SourceFile("later", "1"))
    alone, both = (
        prepare(each, CalibrationOptions()).counts[0].limits[0]
        for each in (clipped, joined([clipped, sound]))
    )
    assert both == SaturatedAxis("x", alone.limit, alone.readings, 2 * alone.of)


def test_limits_together_by_hand() -> None:
    one = (SaturatedAxis("y", -56.0, 40, 100), SaturatedAxis("x", 56.0, 5, 100))
    other = (SaturatedAxis("y", -56.0, 20, 200),)
    found = limits_together([one, other, ()], [100, 200, 100])
    assert found == (SaturatedAxis("x", 56.0, 5, 400), SaturatedAxis("y", -56.0, 60, 400))
    assert saturation_sentence(found).startswith(
        "1% of its readings along x equal the extreme 56 µT, 15% along y -56 µT: its range is "
        "exceeded."
    )


def test_slam_leaves_them_out_with_a_note() -> None:
    limit, field = clipped_drive(0.1)
    first, second = RECORDING.series
    found = mask_dropouts(replace(RECORDING, series=(replace(first, field=field), second)))
    (note,) = found.notes
    assert note.startswith("mag_00: ")
    assert "its range is exceeded" in note
    silent = np.isnan(found.recording.series[0].field).all(axis=1)
    np.testing.assert_array_equal(silent, field[:, 0] == limit)
    assert found.recording.series[1] is second


def test_zeros_of_a_driver_that_fails_are_no_limit() -> None:
    """They are one reading, again and again, and the smallest of an axis that is positive."""
    field = level_rounds(1, 0.1, 2.0) + np.array([0.0, 0.0, 100.0])
    field[np.random.default_rng(1).permutation(len(field))[:40]] = 0.0
    assert saturated_axes(field) == ()
