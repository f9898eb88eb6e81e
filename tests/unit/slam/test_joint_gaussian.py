"""A dense Gaussian over variables: what is learnt of some is carried over to the others."""

import tracemalloc

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_factors import M, X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.joint_gaussian import (
    JointGaussian,
    conditioned,
    local,
    prior_factors,
    retracted,
)
from l2m_gtsam.slam.marginals import joint_posterior
from l2m_gtsam.slam.solver import colamd_ordering, levenberg_marquardt
from tests.reference.dense_newton import newton
from tests.support.stepwise import completed

ROUNDING = 1e-8  # of matrices of condition 1e4, with 1e-12 added to correlations


def spread(rng: np.random.Generator, count: int) -> FloatArray:
    """Return a covariance with sigmas from 0.01 to 1, any way about."""
    turned = np.linalg.qr(rng.normal(size=(count, count)))[0]
    return np.asarray((turned * 10 ** rng.uniform(-4, 0, count)) @ turned.T)


@given(seed=st.integers(0, 10_000), known=st.integers(1, 8), others=st.integers(0, 8))
@settings(deadline=None, max_examples=50)
def test_others_follow_as_if_all_had_been_solved_together(
    seed: int, known: int, others: int
) -> None:
    """Evidence about some components: the dense posterior of all of them, the long way."""
    rng, count = np.random.default_rng(seed), known + others
    P, s = spread(rng, count), np.sort(rng.permutation(count)[:known])
    r = np.setdiff1d(np.arange(count), s)
    J, y = np.zeros((known + 2, count)), rng.normal(size=known + 2)
    J[:, s] = rng.normal(size=(known + 2, known))
    posterior = np.linalg.inv(np.linalg.inv(P) + J.T @ J)
    mean = posterior @ J.T @ y
    after = np.asarray(posterior[np.ix_(s, s)])
    into = np.empty((others, others))
    found, _ = completed(conditioned(P, s, r, mean[s], after, after, into))
    np.testing.assert_allclose(found.shift, mean[r], atol=ROUNDING)
    np.testing.assert_allclose(into, posterior[np.ix_(r, r)], atol=ROUNDING)
    np.testing.assert_allclose(found.cross, posterior[np.ix_(r, s)], atol=ROUNDING)


def known(rng: np.random.Generator, scale: float) -> JointGaussian:
    """Return three poses and the weights of two tiles."""
    values, sizes = gtsam.Values(), {X(0): 6, M(0): 4, X(3): 6, M(1): 3, X(7): 6}
    for key, size in sizes.items():
        at = rng.normal(size=size)
        values.insert(key, gtsam.Pose3.Expmap(at) if size == 6 else at)
    return JointGaussian(values, sizes, scale * spread(rng, sum(sizes.values())))


def seen(rng: np.random.Generator, origin: gtsam.Values, step: float) -> gtsam.NonlinearFactorGraph:
    """Return what is seen of X(3), X(7) and M(1), and of M(9), which is new."""
    noise, graph = gtsam.noiseModel.Isotropic.Sigma, gtsam.NonlinearFactorGraph()
    for key in (X(3), X(7)):
        there = origin.atPose3(key).retract(step * rng.normal(size=6))
        graph.add(gtsam.PriorFactorPose3(key, there, noise(6, 0.1)))
    between = origin.atPose3(X(3)).between(origin.atPose3(X(7)))
    there = between.retract(step * rng.normal(size=6))
    graph.add(gtsam.BetweenFactorPose3(X(3), X(7), there, noise(6, 0.05)))
    at = origin.atVector(M(1)) + step * rng.normal(size=3)
    graph.add(gtsam.PriorFactorVector(M(1), at, noise(3, 0.1)))
    graph.add(gtsam.PriorFactorVector(M(9), np.ones(2), noise(2, 0.3)))
    return graph


def solved(
    graph: gtsam.NonlinearFactorGraph, of: JointGaussian
) -> tuple[gtsam.Values, JointGaussian]:
    """Return where a descent with this prior comes to, and what it says of all variables."""
    values, sizes = gtsam.Values(of.values), {**of.sizes, M(9): 2}
    values.insert(M(9), np.zeros(2))
    whole = gtsam.NonlinearFactorGraph(graph)
    whole.push_back(prior_factors(of))
    for _ in range(3):  # to the last digit
        values = levenberg_marquardt(whole, values, colamd_ordering(whole), 50, 0.0).values
    covariance = joint_posterior(whole.linearize(values), list(sizes)).covariance
    return values, JointGaussian(values, sizes, covariance)


@pytest.mark.parametrize("step", [1e-3, 0.1, 0.5])
def test_gtsam_comes_to_where_dense_newton_steps_lead(step: float) -> None:
    """And has the covariance of its normal equations, of all variables and of few."""
    rng = np.random.default_rng(4)
    before = known(rng, 0.01)
    graph = seen(rng, before.values, step)
    values, whole = solved(graph, before)
    start = gtsam.Values(before.values)
    start.insert(M(9), np.zeros(2))
    reference, covariance = newton(graph, before, start, whole.sizes)
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs(local(reference, values, whole.sizes)).max() < 1e-6
    wrong = (whole.covariance - covariance) / np.outer(sigma, sigma)
    assert np.abs(wrong).max() < 1e-5


@pytest.mark.parametrize(("step", "close"), [(1e-4, 1e-7), (0.1, 0.05)])
def test_what_some_variables_tell_the_others_is_what_all_together_say(
    step: float, close: float
) -> None:
    """For small steps, to the second order of them; for large ones, in sigmas, nearly."""
    rng = np.random.default_rng(3)
    before = known(rng, 0.01)
    graph = seen(rng, before.values, step)
    values, whole = solved(graph, before)
    _, part = solved(graph, before.marginal([X(3), M(1), X(7)]))
    after, _ = completed(before.updated(part))
    assert set(after.sizes) == set(whole.sizes)
    whole = whole.marginal(list(after.sizes))
    apart = local(after.values, values, after.sizes)
    assert np.abs(apart / np.sqrt(np.diag(whole.covariance))).max() < close
    scale = np.sqrt(np.diag(whole.covariance))
    wrong = (after.covariance - whole.covariance) / np.outer(scale, scale)
    assert np.abs(wrong).max() < (1e-3 if step < 1e-3 else 0.2)


@pytest.mark.parametrize("let_go", [(), (X(7),), (X(0),), (M(0), X(3))])
def test_what_is_let_go_is_marginalised(let_go: tuple[int, ...]) -> None:
    rng = np.random.default_rng(6)
    before = known(rng, 0.01)
    part = solved(seen(rng, before.values, 0.1), before.marginal([X(3), M(1), X(7)]))[1]
    (found, _), (whole, _) = (completed(before.updated(part, each)) for each in (let_go, ()))
    assert found.sizes == {key: n for key, n in whole.sizes.items() if key not in let_go}
    left = whole.marginal(list(found.sizes))
    np.testing.assert_allclose(found.covariance, left.covariance, atol=1e-15)
    assert np.abs(local(left.values, found.values, left.sizes)).max() < 1e-12


def test_an_update_needs_one_more_covariance() -> None:
    """And no others of its size: the memory of a large place takes gigabytes."""
    count, few = 2000, 50
    sizes = {M(number): few for number in range(count // few)}
    values = gtsam.Values()
    for key in sizes:
        values.insert(key, np.zeros(few))
    before = JointGaussian(values, sizes, np.eye(count))
    part = before.marginal([M(0)])
    tracemalloc.start()
    after, _ = completed(before.updated(part))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 256 of 2,000 rows are updated at once, and the 50 that are known carry over to all.
    assert most < 1.5 * after.covariance.nbytes


def test_in_pieces_it_is_the_same_update(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a vehicle an update of a large place would take seconds at one key pose."""
    rng = np.random.default_rng(7)
    before = known(rng, 0.01)
    part = before.marginal([X(3), M(1)])
    at_once, pauses = completed(before.updated(part))
    assert pauses == 0
    monkeypatch.setattr("l2m_gtsam.slam.joint_gaussian.PIECE", 5)
    monkeypatch.setattr("l2m_gtsam.slam.joint_gaussian.ROWS", 3)
    in_pieces, pauses = completed(before.updated(part))
    assert pauses == 12  # twice for each three of the 16 others
    np.testing.assert_allclose(in_pieces.covariance, at_once.covariance, atol=1e-15)


def test_nothing_learnt_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    before = known(rng, 0.01)
    after, _ = completed(before.updated(before.marginal([M(0), X(7)])))
    there = after.marginal(list(before.sizes))
    np.testing.assert_allclose(there.covariance, before.covariance, atol=1e-10)
    assert np.abs(local(before.values, there.values, before.sizes)).max() < 1e-12


def test_the_prior_is_what_was_known() -> None:
    """Its error about any values has the gradient and, at the mean, the information it says."""
    rng = np.random.default_rng(8)
    of = known(rng, 0.01)
    prior, count = prior_factors(of), len(of.covariance)
    away = 0.1 * rng.normal(size=count)
    at, side = retracted(of.values, of.sizes, away), 1e-5
    order = gtsam.Ordering(list(of.sizes))
    assert prior.error(at) == pytest.approx(0.5 * away @ np.linalg.solve(of.covariance, away))
    slopes = [
        prior.error(retracted(at, of.sizes, side * axis))
        - prior.error(retracted(at, of.sizes, -side * axis))
        for axis in np.eye(count)
    ]
    _, descent = prior.linearize(at).hessian(order)
    np.testing.assert_allclose(
        np.array(slopes) / (2 * side), -descent, atol=1e-6 * np.abs(descent).max()
    )
    H, _ = prior.linearize(of.values).hessian(order)
    np.testing.assert_allclose(H @ of.covariance, np.eye(count), atol=1e-6)
