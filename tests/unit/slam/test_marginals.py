"""Covariances of many poses, one by one and all at once, and where Cholesky is refused."""

from itertools import permutations

import gtsam
import numpy as np
import pytest

from l2m_factors import T, X
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.slam.marginals import (
    Marginals,
    joint_posterior,
    net_covariance,
    pose_covariances,
    reported_ill_conditioning,
)
from l2m_gtsam.slam.solver import (
    colamd_ordering,
)
from tests.drives.pose_chain import FAR_APART, chain, off

COUNT = 230  # poses


def test_poses_together_are_as_sure_as_one_by_one() -> None:
    """A chain of poses that all see one landmark, of which they know little."""
    rng, graph, values = np.random.default_rng(3), gtsam.NonlinearFactorGraph(), gtsam.Values()
    step = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.02, 0.05, 0.05, 0.03]))
    pose = gtsam.Pose3()
    graph.add(gtsam.PriorFactorPose3(X(0), pose, step))
    graph.add(gtsam.PriorFactorPoint3(T(0), np.ones(3), gtsam.noiseModel.Isotropic.Sigma(3, 2.0)))
    values.insert(T(0), np.ones(3))
    for k in range(COUNT):
        values.insert(X(k), pose)
        away = np.linalg.norm(pose.transformTo(np.ones(3)))
        seen = gtsam.noiseModel.Isotropic.Sigma(1, 0.02)
        graph.add(gtsam.RangeFactor3D(X(k), T(0), away, seen))
        move = gtsam.Pose3.Expmap(rng.normal(0, 0.2, 6))
        if k + 1 < COUNT:
            graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), move, step))
        pose = pose.compose(move)
    marginals = Marginals(graph.linearize(values), colamd_ordering(graph))
    alone = np.stack([marginals.of(X(k)) for k in range(COUNT)])
    together = pose_covariances(marginals, COUNT)
    np.testing.assert_allclose(together, alone, rtol=1e-7, atol=1e-9 * alone.max())


def test_determinants_are_those_of_the_dense_information() -> None:
    """Of all nine poses, and of seven of them with the others integrated out."""
    graph, values, _ = chain([0.01] * 3 + [0.1] * 3, [0.02] * 3 + [0.05] * 3)
    linear = graph.linearize(values)
    marginals = Marginals(linear, colamd_ordering(graph))
    keys = [X(k) for k in range(9)]
    H = linear.hessian(gtsam.Ordering(keys))[0]
    assert marginals.log_determinant() == pytest.approx(0.5 * np.linalg.slogdet(H)[1], rel=1e-12)
    rows = np.r_[0:12, 18:24, 30:54]  # without the third and the fifth
    rest = np.linalg.inv(np.linalg.inv(H)[np.ix_(rows, rows)])
    half = 0.5 * np.linalg.slogdet(rest)[1]
    # Two inverses: to the condition of the information, 1e6, times rounding.
    assert marginals.log_determinant([keys[2], keys[4]]) == pytest.approx(half, rel=1e-9)


@pytest.mark.parametrize(("start", "step"), FAR_APART)
def test_where_cholesky_is_refused_covariances_come_from_qr(
    start: list[float], step: list[float]
) -> None:
    graph, values, P = chain(start, step)
    with pytest.raises(RuntimeError, match="ndetermina"):
        gtsam.Marginals(graph, values).marginalCovariance(X(8))
    linear = graph.linearize(values)
    marginals = Marginals(linear, colamd_ordering(graph))
    alone = [marginals.of(X(k)) for k in range(len(P))]
    together = pose_covariances(marginals, len(P))
    pair, last = (joint_posterior(linear, keys).covariance for keys in ([X(5), X(2)], [X(8)]))
    for k, true in enumerate(P):
        assert off(alone[k], true) < 1e-5
        # Where GTSAM lets Cholesky pass: half of the digits, for sigmas 1e12 apart.
        assert off(together[k], true) < 1e-4
    assert off(pair[:6, :6], P[5]) < 1e-5
    assert off(pair[6:, 6:], P[2]) < 1e-5
    assert off(last, P[8]) < 1e-5


@pytest.mark.parametrize(("start", "step"), [([0.1] * 6, [0.02] * 6), *FAR_APART])
@pytest.mark.parametrize("keys", [[X(8)], [X(3), X(0)]])
def test_a_posterior_tells_what_a_step_promises(
    start: list[float], step: list[float], keys: list[int]
) -> None:
    """The error of the linear graph at zero less that at its solution, whoever is asked for."""
    graph, values, _ = chain(start, step)
    rng, away = np.random.default_rng(6), gtsam.Values()
    for key in values.keys():  # noqa: SIM118 - GTSAM's values cannot be iterated
        away.insert(key, values.atPose3(key).retract(0.1 * rng.normal(size=6)))
    linear = graph.linearize(away)
    solution = linear.optimize(colamd_ordering(graph), gtsam.EliminateQR)
    promised = linear.error(away.zeroVectors()) - linear.error(solution)
    assert promised > 1.0
    found = joint_posterior(linear, keys)
    assert found.decrease == pytest.approx(promised, rel=1e-6)
    mean = np.concatenate([solution.at(key) for key in keys])
    # Cholesky loses digits where poses are far apart, far below what is known of them.
    assert np.abs((found.mean - mean) / np.sqrt(np.diag(found.covariance))).max() < 1e-3


def test_what_no_factor_tells_is_refused_in_one_line() -> None:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    step = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph.add(gtsam.BetweenFactorPose3(X(0), X(1), gtsam.Pose3(), step))
    for k in (0, 1):
        values.insert(X(k), gtsam.Pose3())
    with pytest.raises(CalibrationError, match="orders of magnitude"), reported_ill_conditioning():
        joint_posterior(graph.linearize(values), [X(1)])


def test_covariances_are_in_the_order_asked_for_whatever_gtsam_eliminates_first() -> None:
    """Two variables that hang on a third one alone: GTSAM takes its branches in either order."""
    rng, sizes = np.random.default_rng(7), {X(0): 2, X(1): 3, X(2): 1}
    linear = gtsam.GaussianFactorGraph()
    for key, size in sizes.items():
        unit = gtsam.noiseModel.Unit.Create(size)
        linear.add(gtsam.JacobianFactor(key, rng.normal(size=(size, size)), np.zeros(size), unit))
    for key in (X(0), X(1)):
        blocks = [rng.normal(size=(2, sizes[each])) for each in (key, X(2))]
        unit = gtsam.noiseModel.Unit.Create(2)
        linear.add(gtsam.JacobianFactor(key, blocks[0], X(2), blocks[1], np.zeros(2), unit))
    out_of_turn = 0
    for keys in permutations(sizes):
        net = linear.eliminateSequential(gtsam.Ordering(keys), gtsam.EliminateQR)
        out_of_turn += net.at(0).firstFrontalKey() != keys[0]
        H = linear.hessian(gtsam.Ordering(keys))[0]
        # The condition of H, 1e3, times rounding.
        np.testing.assert_allclose(net_covariance(net, keys), np.linalg.inv(H), rtol=1e-11)
    assert out_of_turn > 0
