"""Numbers at the times of readings: interpolation, gaps, ends."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from l2m_gtsam.data import IntArray, ScalarSeries
from l2m_gtsam.recording.regressors import ResampleOptions, resampled

START = 1_700_000_000_000_000_000


def at(seconds: list[float] | np.ndarray) -> IntArray:
    return START + np.round(np.asarray(seconds) * 1e9).astype(np.int64)


def series(seconds: list[float], values: list[float], name: str = "motor") -> ScalarSeries:
    return ScalarSeries(name, "/" + name, at(seconds), np.array(values, dtype=float))


@given(st.lists(st.floats(0, 4), min_size=1), st.floats(-3, 3), st.floats(-5, 5))
def test_a_straight_line_is_met_between_samples(
    seconds: list[float], slope: float, value: float
) -> None:
    grid = np.arange(0, 4.01, 0.25)
    line = series(list(grid), list(value + slope * grid))
    found = resampled([line], at(seconds), ResampleOptions())
    assert found.known.all()
    # Stamps are whole nanoseconds, half of one at a slope of 3 per second.
    np.testing.assert_allclose(found.values[:, 0], value + slope * np.array(seconds), atol=1e-8)


def test_gaps_and_ends_are_not_bridged() -> None:
    motor = series([0.0, 0.5, 2.0, 2.4], [0, 1, 2, 3])
    times = at([-0.1, 0.0, 0.25, 0.5, 0.6, 1.9, 2.0, 2.2, 2.4, 2.5])
    found = resampled([motor], times, ResampleOptions())
    np.testing.assert_array_equal(
        found.known, [False, True, True, True, False, False, True, True, True, False]
    )
    np.testing.assert_allclose(found.values[found.known, 0], [0, 0.5, 1, 2, 2.5, 3])
    assert (found.values[~found.known] == 0).all()
    assert resampled([motor], times, ResampleOptions(max_gap_s=1.5)).known.sum() == 8


def test_a_reading_is_known_where_all_numbers_are() -> None:
    both = [series([0, 0.4, 0.8], [1, 1, 1], "a"), series([0.4, 0.8, 1.2], [2, 2, 2], "b")]
    found = resampled(both, at([0.2, 0.6, 1.0]), ResampleOptions())
    np.testing.assert_array_equal(found.known, [False, True, False])
    np.testing.assert_array_equal(found.values, [[1, 0], [1, 2], [0, 2]])


def test_nothing_to_resample() -> None:
    times = at([0.0, 1.0])
    none = resampled([], times, ResampleOptions())
    assert none.values.shape == (2, 0)
    assert none.known.all()
    empty = resampled([series([], [])], times, ResampleOptions())
    assert not empty.known.any()
    assert resampled([series([0], [1])], times[:0], ResampleOptions()).values.shape == (0, 1)


def test_gaps_must_have_a_length() -> None:
    with pytest.raises(ValidationError):
        ResampleOptions(max_gap_s=0)
