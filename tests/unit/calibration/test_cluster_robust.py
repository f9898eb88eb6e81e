"""The scatter of parts of a drive against what a linear model expects of it, in closed form."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.calibration.cluster_robust import (
    BLOCKS,
    WHOLE,
    Excess,
    directions_of,
    gathered,
    halved,
    scatters,
    unmodelled,
)
from l2m_gtsam.calibration.joint_information import Rows
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.records.error_budget import EXPLAINED, Unmodelled

READINGS, SHARED, FEW = 240, 12, 8
LASTS = READINGS // 16  # readings in a row: a part of the drive
OWN = SHARED + np.arange(SENSOR)


@dataclass(frozen=True)
class Fitted:
    """A linear fit: rows at the optimum, all variables with their covariance, and the error."""

    readings: Readings
    rows: list[Rows]
    x: FloatArray
    covariance: FloatArray
    error: FloatArray

    def unmodelled(self) -> Excess:
        found = scatters(self.readings, self.rows, OWN, self.covariance)
        return unmodelled(found, OWN, self.covariance, 1)


def fitted(rng: np.random.Generator, lasting: float = 0.0) -> Fitted:
    """Fit sixteen parameters beside errors that are shared, with white noise of unit variance.

    ``lasting`` is the standard deviation of an error beside it that the fit does not know of: the
    same in all axes and in all readings of a part of the drive.
    """
    X = rng.standard_normal((3 * READINGS, SHARED + SENSOR))
    X[:, :SHARED] *= rng.random((3 * READINGS, SHARED)) < 0.2
    weights = rng.standard_normal(SHARED)
    wrong = rng.standard_normal(3 * READINGS)
    wrong += np.repeat(lasting * rng.standard_normal(READINGS // LASTS), 3 * LASTS)
    # An error that lasts harms an estimate only where its readings feel the parameter alike.
    alike = 0.3 * rng.standard_normal((READINGS // LASTS, SENSOR))
    X[:, SHARED:] += np.repeat(alike, 3 * LASTS, axis=0)
    information = X.T @ X
    information[:SHARED, :SHARED] += np.eye(SHARED)
    covariance = np.linalg.inv(information)
    z = X[:, :SHARED] @ weights + wrong
    x = covariance @ (X.T @ z)
    residual, several = X @ x - z, np.array_split(np.arange(READINGS), FEW)
    rows = [
        Rows(0, np.arange(SHARED + SENSOR), X[at], residual[at], part)
        for part in several
        for at in [(3 * part[:, None] + np.arange(3)).ravel()]
    ]
    places = rng.uniform(-5, 5, (READINGS, 3))
    readings = Readings(
        sensors=("mag",),
        sensor=np.zeros(READINGS, dtype=np.int64),
        stamp_ns=np.arange(READINGS) * 10**8,
        R_map_lidar=np.broadcast_to(np.eye(3), (READINGS, 3, 3)),
        p_map_lidar=places,
        field=np.zeros((READINGS, 3)),
    )
    return Fitted(readings, rows, x, np.asarray(covariance, dtype=np.float64), x[OWN])


def test_expected_scores_are_those_of_many_fits() -> None:
    rng = np.random.default_rng(1)
    one = fitted(rng)
    labels = halved(one.readings.stamp_ns[:, None].astype(np.float64), 4)
    scores = gathered(one.rows, labels, OWN, one.covariance).scores(one.covariance)
    X = np.vstack([each.jacobian for each in one.rows])
    # e = (I - X P X^T) noise + prior's share; its covariance is I - X P X^T.
    left = np.eye(len(X)) - X @ one.covariance @ X.T
    for part, expected in enumerate(scores.expected):
        Y = X[np.repeat(labels == part, 3)] @ one.covariance[:, OWN]
        block = left[np.ix_(np.repeat(labels == part, 3), np.repeat(labels == part, 3))]
        np.testing.assert_allclose(expected, Y.T @ block @ Y, rtol=1e-9, atol=1e-15)


def test_scores_add_up_to_the_pull_of_the_priors() -> None:
    one = fitted(np.random.default_rng(2))
    labels = halved(one.readings.p_map_lidar, 4)
    sums = gathered(one.rows, labels, OWN, one.covariance)
    size = np.abs(sums.found).sum(axis=0)
    # The shared errors are known to be zero, with unit variance.
    pull = -one.covariance[OWN, :SHARED] @ one.x[:SHARED]
    assert np.all(np.abs(sums.found.sum(axis=0) - pull) < 1e-9 * size)
    # And what all of them bring is the covariance but for those priors.
    priors = one.covariance[OWN, :SHARED] @ one.covariance[:SHARED, OWN]
    own = one.covariance[np.ix_(OWN, OWN)]
    np.testing.assert_allclose(sums.brought.sum(axis=0) + priors, own, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(sums.paired().found[0], sums.found[:2].sum(axis=0))


def test_what_the_model_explains_is_left_alone() -> None:
    rng = np.random.default_rng(3)
    flagged = sum(fitted(rng).unmodelled().factors != EXPLAINED for _ in range(150))
    # Two of a thousand are allowed; of 150, more than three come by chance once in 3,000.
    assert flagged <= 3


def test_an_error_that_lasts_is_found_and_counted() -> None:
    rng = np.random.default_rng(4)
    distances: dict[str, list[float]] = {name: [] for name in BLOCKS}
    stated, together = [], []
    for _ in range(60):
        one = fitted(rng, lasting=2.0)
        found = one.unmodelled()
        P = one.covariance[np.ix_(OWN, OWN)]
        wide, e = found.widened(P), one.error[WHOLE]
        together.append(float(e @ np.linalg.solve(wide[WHOLE, WHOLE], e)) / len(e))
        for name, block in BLOCKS.items():
            e = one.error[block]
            distances[name].append(float(e @ np.linalg.solve(wide[block, block], e)) / len(e))
            stated.append(float(e @ np.linalg.solve(P[block, block], e)) / len(e))
    assert np.mean(stated) > 10  # the model's own covariance is far too small
    # Sums of t, C and H, too, which blocks one by one leave as well known as the model has them.
    assert 0.7 < np.mean(together) < 1.7
    for name, found_distances in distances.items():
        # Sixteen parts of which the fit takes some leave heavy tails: 1.04 to 1.37 over many seeds.
        assert 0.7 < np.mean(found_distances) < 1.7, name


@given(
    seed=st.integers(0, 10_000),
    factors=st.lists(st.floats(1.0, 50.0), min_size=4, max_size=4),
    whole=st.floats(1.0, 20.0),
)
@settings(max_examples=40, deadline=None)
def test_a_wider_covariance_lies_between_the_models_and_its_largest_multiple(
    seed: int, factors: list[float], whole: float
) -> None:
    """In every direction: one that is known well stays known better than the others."""
    A = np.random.default_rng(seed).standard_normal((16, 20))
    P = A @ A.T
    factors = [max(factor, whole) for factor in factors]
    excess = Excess(Unmodelled(*factors), whole, P)
    wide = excess.widened(P)
    most = whole + sum(factor - whole for factor in factors)
    size = np.linalg.norm(wide)
    assert np.linalg.eigvalsh(wide - whole * P).min() > -1e-9 * size
    assert np.linalg.eigvalsh(most * P - wide).min() > -1e-9 * size
    for factor, block in zip(factors, BLOCKS.values(), strict=True):
        own = wide[block, block] - factor * P[block, block]
        assert np.linalg.eigvalsh(own).min() > -1e-9 * size


def test_few_readings_tell_nothing() -> None:
    one = fitted(np.random.default_rng(5), lasting=5.0)
    few = [Rows(0, r.columns, r.jacobian[:3], r.residual[:3], r.readings[:1]) for r in one.rows]
    assert not scatters(one.readings, few, OWN, one.covariance)
    assert unmodelled((), OWN, one.covariance, 1).factors == EXPLAINED


@given(
    count=st.integers(16, 300),
    axes=st.integers(1, 3),
    times=st.integers(1, 4),
    seed=st.integers(0, 1000),
)
@settings(max_examples=30, deadline=None)
def test_parts_are_of_one_size(count: int, axes: int, times: int, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(size=(count, axes))
    sizes = np.bincount(halved(points, times), minlength=2**times)
    assert sizes.max() - sizes.min() <= 1
    pairs = halved(points, times - 1)
    np.testing.assert_array_equal(halved(points, times) // 2, pairs)


@pytest.mark.parametrize("block", BLOCKS)
def test_covariances_grow_where_something_is_unmodelled(block: str) -> None:
    excess = Unmodelled(**{block: 4.0})
    at = BLOCKS[block]
    np.testing.assert_array_equal(excess.scale[at], 2.0)
    assert excess.scale.sum() == SENSOR + (at.stop - at.start)


@given(st.integers(0, 10_000), st.sampled_from([1, 2, 9]))
@settings(max_examples=30, deadline=None)
def test_scores_tell_in_how_many_directions_they_differ(seed: int, several: int) -> None:
    rng, parts, n = np.random.default_rng(seed), 2000, 9
    turned = np.linalg.qr(rng.standard_normal((n, n)))[0][:several]
    found = directions_of(rng.standard_normal((parts, several)) @ turned)
    assert found == pytest.approx(several, rel=0.1)  # two thousand parts: three per cent


def test_few_parts_tell_of_few_directions_too() -> None:
    rng = np.random.default_rng(6)
    found = [directions_of(rng.standard_normal((8, 3))) for _ in range(400)]
    assert 2.0 < np.mean(found) < 3.0  # of three; a mean of seven squares each
    assert min(found) >= 1
