"""Place or vehicle: what is free under each explanation, and what is said."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array

from l2m_gtsam.calibration.averaged_rows import with_calibration
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.found_sources import nothing_found
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.qa.metrics.coordinates import PARAMETERS
from l2m_gtsam.records.places import CLEAR, WhatChanged
from l2m_gtsam.records.validation import CalibrationPart
from l2m_gtsam.solve.linear_algebra import RowBlocks
from l2m_gtsam.validation.places import (
    ANYTHING,
    PlaceOrVehicle,
    spread,
    who_changed,
)

SEEDS = st.integers(0, 10_000)
SIGMA = np.repeat([0.003, 0.01, 0.3, 0.002], [3, 9, 3, 1])
OFFSET, PLACE = CalibrationPart.OFFSET, CalibrationPart.PLACE


def rows_of(design: FloatArray, e: FloatArray) -> MarginalRows:
    """N readings of one sensor with white noise of 1 uT and no other error."""
    N = len(design) // 3
    return MarginalRows(
        points=np.zeros((N, 3)),
        residual=e.reshape(N, 3),
        whitening=csr_array(np.eye(3 * N)),
        nuisance=RowBlocks.of(design),
        prior=np.eye(PARAMETERS),
        slot=np.arange(N),
    )


@given(SEEDS, st.sampled_from([(), (OFFSET,), (PLACE, OFFSET)]))
def test_what_is_free_is_the_calibration_and_the_parts_that_changed(
    seed: int, parts: tuple[CalibrationPart, ...]
) -> None:
    """The squared length under the prior is that of e in the covariance I + J (P + change) J^T."""
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((60, PARAMETERS)) / (5 * SIGMA)
    e = 3 * rng.standard_normal(60)
    P = np.diag(SIGMA**2) + spread(np.eye(3), parts)
    held = with_calibration(rows_of(J, e), P[None])
    squared = held.pull(held.residual)[1]
    expected = e @ np.linalg.solve(np.eye(60) + J @ P @ J.T, e)
    # Of a covariance whose variances are up to ten decades apart.
    assert squared == pytest.approx(float(expected), rel=1e-4)


def test_a_part_that_changed_may_be_anything() -> None:
    free = np.sqrt(np.diag(spread(np.eye(3), (OFFSET,))))
    np.testing.assert_allclose(free, np.repeat([0.0, ANYTHING[OFFSET], 0.0], [12, 3, 1]))
    assert not spread(np.eye(3), ()).any()


def judged(*gains: float) -> PlaceOrVehicle:
    names = ("the place changed, not the vehicle", "the vehicle changed, not the place")
    told = tuple(
        WhatChanged(words, gain, of_place=k == 0)
        for k, (words, gain) in enumerate(zip(names, gains, strict=True))
    )
    none = nothing_found(rows_of(np.zeros((3, PARAMETERS)), np.zeros(3)))
    return PlaceOrVehicle(told, none, ())


def test_the_words_follow_the_best() -> None:
    assert judged(100.0, 20.0).sentence == (
        "The place changed, not the vehicle, by the likelihood of the same readings (the place "
        "changed, not the vehicle: 100, the vehicle changed, not the place: 20)."
    )


@pytest.mark.parametrize(("behind", "tied"), [(0.9 * CLEAR, True), (1.1 * CLEAR, False)])
def test_a_tie_is_called_a_tie(behind: float, tied: bool) -> None:
    found = judged(100.0, 100.0 - behind)
    assert found.tied is tied
    start = (
        "The readings do not show which: the place changed, not the vehicle, or the vehicle "
        "changed, not the place, by"
    )
    assert found.sentence.startswith(start) is tied


@pytest.mark.parametrize(
    ("parts", "who"),
    [
        (((OFFSET,), (OFFSET,)), "the vehicle"),
        (((), (OFFSET, PLACE)), "sensor b alone"),
    ],
)
def test_one_sensor_of_several_is_named(
    parts: tuple[tuple[CalibrationPart, ...], ...], who: str
) -> None:
    assert who_changed(("a", "b"), parts) == who


def test_an_only_sensor_is_the_vehicle() -> None:
    assert who_changed(("a",), ((OFFSET,),)) == "the vehicle"
