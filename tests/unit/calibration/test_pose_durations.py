"""The duration of errors from their correlation at several distances in time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from l2m_gtsam.calibration.pose_durations import LAGS, SharedErrors, most_likely
from l2m_gtsam.data import FloatArray

BIN_S = 0.05
SIGMA = 0.02


def shared(correlation: FloatArray, of_map: float = 0.1) -> SharedErrors:
    covariance = SIGMA**2 * np.eye(len(LAGS))
    return SharedErrors(BIN_S, LAGS, correlation, covariance, np.full(len(LAGS), of_map))


def at(lasting: float) -> FloatArray:
    """Return the correlation of errors that last so long."""
    return np.asarray(shared(np.zeros(len(LAGS))).expected(np.array(lasting))[0])


@pytest.mark.parametrize("seconds", [0.02, 0.3])
def test_the_expected_correlation_is_the_mean_over_two_bins(seconds: float) -> None:
    empty = shared(np.zeros(len(LAGS)))
    for lag, expected in list(zip(LAGS, empty.expected(np.array(seconds))[0], strict=True))[:4]:
        mean, _ = dblquad(
            lambda y, x, lag=lag: np.exp(-(lag + y - x) * BIN_S / seconds), 0, 1, 0, 1
        )
        assert expected == pytest.approx(mean, rel=1e-7)  # quadrature's own error is below that


@settings(max_examples=30)
@given(
    lasting=st.one_of(st.floats(0.03, 0.25), st.floats(3.0, 10.0)),
    share=st.floats(0.0, 1.0),
    seed=st.integers(0, 2**16),
)
def test_the_duration_is_found_beside_errors_of_the_map(
    lasting: float, share: float, seed: int
) -> None:
    empty = shared(np.zeros(len(LAGS)))
    noise = np.random.default_rng(seed).normal(0.0, SIGMA, len(LAGS))
    correlation = at(lasting) + share * empty.of_map * at(1.0) + noise
    found = most_likely(shared(correlation), 1.0)
    assert found is not None
    # Map and poses together are known to SIGMA of one, 0.1 of it may be the map's.
    assert abs(np.log(found / lasting)) < np.log(1.5)


@settings(max_examples=30)
@given(size=st.floats(0.15, 0.4), lasting=st.floats(0.3, 0.5))
def test_errors_that_are_smaller_than_stated_do_not_count_as_shorter(
    size: float, lasting: float
) -> None:
    found = most_likely(shared(size * at(lasting), of_map=0.0), lasting)
    assert found is None or found == pytest.approx(lasting, rel=0.5)


def test_what_is_assumed_stays_if_nothing_contradicts_it() -> None:
    assert most_likely(shared(at(1.1)), 1.0) is None
