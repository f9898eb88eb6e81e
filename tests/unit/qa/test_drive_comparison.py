"""What several drives say of one sensor, against generalised least squares and by chance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.repeatability import (
    PartialEstimate,
    common,
    compare_drives,
    compare_halves,
)
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.repeatability import halves_agree

TRUE = np.concatenate([[0.1, 0.2, 0.3], np.eye(3).ravel(), [1.0, 2.0, 3.0]])
SCALE = np.repeat([1e-3, 1e-3, 1e-1], [3, 9, 3])
SEEDS = st.integers(0, 10_000)


def parts(seed: int, count: int, shared: float = 1.0) -> list[PartialEstimate]:
    """Return honest parts: errors of their own, and errors of one map that all feel in their way.

    ``shared`` is the size of the latter beside the former.
    """
    rng = np.random.default_rng(seed)
    beta, found = rng.normal(size=8), []
    for _ in range(count):
        root = SCALE[:, None] * rng.normal(size=(15, 40)) / 40**0.5
        G = shared * SCALE[:, None] * rng.normal(size=(15, 8)) / 8**0.5
        vector = TRUE + root @ rng.normal(size=40) + G @ beta
        found.append(PartialEstimate(vector, root @ root.T + G @ G.T, G))
    return found


def named(found: list[PartialEstimate]) -> list[tuple[str, PartialEstimate | str]]:
    return [(f"{k}.bag", each) for k, each in enumerate(found)]


def stacked(found: list[PartialEstimate]) -> FloatArray:
    """Return the covariance of all parts side by side."""
    G = np.vstack([each.shared_root for each in found if each.shared_root is not None])
    whole = G @ G.T
    for k, each in enumerate(found):
        at = slice(15 * k, 15 * k + 15)
        whole[at, at] = each.covariance
    return np.asarray(whole)


@given(SEEDS, st.integers(2, 4))
@settings(max_examples=20, deadline=None)
def test_the_common_value_is_that_of_least_squares(seed: int, count: int) -> None:
    found = parts(seed, count)
    A, S = np.tile(np.eye(15), (count, 1)), stacked(found)
    covariance = np.linalg.inv(A.T @ np.linalg.solve(S, A))
    y = np.concatenate([each.vector for each in found])
    expected = covariance @ A.T @ np.linalg.solve(S, y)
    whole = common(found)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((whole.part.vector - expected) / sigma, 0, atol=1e-5)
    np.testing.assert_allclose(
        whole.part.covariance / np.outer(sigma, sigma),
        covariance / np.outer(sigma, sigma),
        atol=1e-5,
    )
    left = y - A @ expected
    assert whole.squared == pytest.approx(left @ np.linalg.solve(S, left), rel=1e-4)
    assert whole.freedom == 15 * (count - 1)


def test_honest_drives_are_within_the_band_and_the_shared_map_does_not_count() -> None:
    """Of 300 sets of three drives 95 % within the band: 285, give or take four sigmas of 3.8.

    The map's errors are three times the others: counted as each drive's own they would be all
    there is.
    """
    within, squares = 0, []
    for seed in range(300):
        found = compare_drives(named(parts(seed, 3, shared=3.0)))
        within += found.low < found.squared < found.high
        squares.append(found.squared / found.freedom)
    assert abs(within - 285) <= 16
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / 30 / 300))


def test_of_two_drives_the_whole_is_the_pair() -> None:
    one, other = parts(3, 2)
    found, pair = compare_drives(named([one, other])), compare_halves(one, other)
    assert found.squared == pytest.approx(pair.distance**2 * pair.determined, rel=1e-6)
    assert found.freedom == pair.determined == 15
    assert found.drives[1].others.difference == pytest.approx(pair.difference, abs=2e-6)
    assert found.drives[0].others.distance == pytest.approx(pair.distance, rel=1e-6)


def test_shared_errors_that_are_alike_drop_out() -> None:
    """Of the same way driven twice the map errs alike. To rounding in the sixth digit."""
    own, G = np.diag((0.1 * SCALE) ** 2), np.diag(SCALE)
    error = G @ np.random.default_rng(1).normal(size=15)
    one, other = (PartialEstimate(TRUE + error, own + G @ G.T, G) for _ in range(2))
    np.testing.assert_allclose(
        compare_halves(one, other).sigma, np.sqrt(2) * 0.1 * SCALE, atol=1e-6
    )


@pytest.mark.parametrize("moved", [0, 1, 2, 3])
def test_the_drive_in_which_a_sensor_moved_is_the_furthest(moved: int) -> None:
    found = parts(5, 4)
    shifted = found[moved].vector + np.concatenate([[0.03, 0, 0], np.zeros(12)])
    found[moved] = PartialEstimate(shifted, found[moved].covariance, found[moved].shared_root)
    repeat = compare_drives(named(found))
    distances = [each.others.distance for each in repeat.drives]
    assert int(np.argmax(distances)) == moved
    assert repeat.squared > repeat.high
    t, C, H = repeat.drives[moved].largest
    assert t > 10
    assert t > max(C, H)


def test_what_a_drive_leaves_open_takes_no_part() -> None:
    found = parts(7, 3)
    open_ = found[1].covariance.copy()
    open_[2, :] = open_[:, 2] = 0.0
    open_[2, 2] = np.inf
    wild = found[1].vector.copy()
    wild[2] = 1e6
    found[1] = PartialEstimate(wild, open_, found[1].shared_root)
    repeat = compare_drives(named(found))
    assert repeat.freedom == 15 + 14
    assert repeat.squared < 2 * repeat.high
    assert np.isnan(repeat.drives[1].estimate[2])
    assert repeat.drives[1].others.determined == 14
    assert repeat.drives[0].others.determined == 15


def test_drives_that_say_nothing_are_said() -> None:
    one = parts(1, 1)[0]
    nothing = PartialEstimate(np.zeros(15), np.diag(np.full(15, np.inf)))
    found = compare_drives([("a", one), ("b", "12 readings are too few"), ("c", nothing)])
    assert found.freedom == 0
    assert not found.compared
    reasons = [each.reason for each in found.drives]
    assert reasons[0] == "there is no other drive to compare with"
    assert reasons[1] == "12 readings are too few"
    assert "determines nothing" in reasons[2]
    assert np.isfinite(found.drives[0].sigma).all()


@pytest.mark.parametrize("count", [2, 3])
def test_a_drive_beside_others_that_leave_all_of_a_part_open(count: int) -> None:
    """As of short loops beside a whole drive: they determine neither z nor the third column of C.

    Nobody else knows these, and the angle between rotations neither.
    """
    found = parts(5, count)
    unknown = [2, 5, 8, 11]
    for k in range(1, count):
        covariance = found[k].covariance.copy()
        covariance[unknown, :] = covariance[:, unknown] = 0
        covariance[unknown, unknown] = np.inf
        found[k] = PartialEstimate(found[k].vector, covariance, found[k].shared_root)
    whole = compare_drives(named(found))
    for each in whole.drives:
        known = np.isfinite(each.others.difference)
        np.testing.assert_array_equal(np.flatnonzero(~known), unknown)
        assert np.isnan(each.others.turned_deg)
        assert [(group.name, group.freedom) for group in each.others.distances] == [
            ("t", 2),
            ("C", 6),
            ("H", 3),
        ]
    assert halves_agree(whole.drives[0].others, QaOptions())
