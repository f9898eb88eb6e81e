"""What earlier readings still say: beside the covariance of all readings, written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.evidence import Normal, condition, evidence
from l2m_gtsam.maps.harmonic.tile_sums import carried, faded, likelihood, share_left

NOISE = 0.3
SEEDS = st.integers(0, 10_000)


def sums(F: FloatArray, y: FloatArray) -> Normal:
    return Normal(F.T @ F, F.T @ y, float(y @ y), len(y), 0.0)


def drawn(seed: int) -> tuple[list[FloatArray], list[FloatArray], FloatArray, list[FloatArray]]:
    """Features and readings of three drives, the prior, and two steps: some weights stay."""
    rng = np.random.default_rng(seed)
    features = [rng.standard_normal((n, 4)) for n in (7, 5, 6)]
    readings = [rng.standard_normal(len(F)) for F in features]
    steps = [rng.uniform(0, 0.95, 4) * (rng.uniform(size=4) < 0.7) for _ in range(2)]
    return features, readings, rng.uniform(0.2, 2.0, 4), steps


@given(SEEDS)
def test_sums_are_those_of_weights_that_step_by_step_move(seed: int) -> None:
    """Mean, covariance and likelihood are those of the joint normal distribution."""
    F, y, sigma, steps = drawn(seed)
    alike = [np.sqrt(1 - each**2) for each in steps]
    S = np.diag(sigma**2)
    # w1 = a w2 + r x: correlations of weights of different drives are products of a.
    to_last = [alike[0] * alike[1], alike[1], np.ones(4)]

    def across(i: int, j: int) -> FloatArray:
        return np.asarray(to_last[min(i, j)] / to_last[max(i, j)])

    blocks = [[F[i] @ (across(i, j)[:, None] * S) @ F[j].T for j in range(3)] for i in range(3)]
    every, z = np.block(blocks), np.concatenate(y)
    every += NOISE**2 * np.eye(len(z))
    now = np.hstack([(to_last[i][:, None] * S) @ F[i].T for i in range(3)])
    total = carried([sums(*each) for each in zip(F, y, strict=True)], steps, sigma, NOISE)
    found = condition(total, 2 * np.log(sigma), NOISE)
    np.testing.assert_allclose(found.mean, now @ np.linalg.solve(every, z), atol=1e-8)
    root = found.root(np.eye(4))
    expected = S - now @ np.linalg.solve(every, now.T)
    np.testing.assert_allclose(root @ root.T, expected, atol=1e-8)
    before = carried([sums(F[0], y[0]), sums(F[1], y[1])], steps[:1], sigma, NOISE)
    value = likelihood(before, sums(F[2], y[2]), 2 * np.log(sigma), NOISE, steps[1])
    log_det = np.linalg.slogdet(2 * np.pi * every)[1]
    exact = -0.5 * (z @ np.linalg.solve(every, z) + log_det)
    assert value == pytest.approx(exact, abs=1e-7)


@given(SEEDS)
def test_nothing_moves_and_all_moves(seed: int) -> None:
    F, y, sigma, _ = drawn(seed)
    first = sums(F[0], y[0])
    assert faded(first, sigma, NOISE, np.zeros(4)) is first
    gone = faded(first, sigma, NOISE, np.ones(4))
    assert not gone.FF.any()
    assert not gone.Fy.any()
    assert share_left(first, sigma, NOISE, np.zeros(4)) == 1.0
    assert share_left(first, sigma, NOISE, np.ones(4)) == 0.0
    alone = evidence(sums(F[1], y[1]), 2 * np.log(sigma), NOISE).value
    other = evidence(first, 2 * np.log(sigma), NOISE).value
    both = likelihood(first, sums(F[1], y[1]), 2 * np.log(sigma), NOISE, np.ones(4))
    assert both == pytest.approx(alone + other, abs=1e-8)
