"""Covariances of variables that share a factor, against the dense inverse."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_factors import X
from l2m_gtsam.slam.selected_inverse import ROOT, cliques_of, shared_covariances


def random_graph(
    rng: np.random.Generator, count: int, factors: int
) -> tuple[gtsam.GaussianFactorGraph, dict[int, int], list[list[int]]]:
    """Variables of one to four components, all with priors, and factors on pairs of them."""
    sizes = {X(k): int(rng.integers(1, 5)) for k in range(count)}
    graph, groups = gtsam.GaussianFactorGraph(), [[key] for key in sizes]
    for key, size in sizes.items():
        unit = gtsam.noiseModel.Unit.Create(size)
        graph.add(gtsam.JacobianFactor(key, np.eye(size), rng.normal(size=size), unit))
    for _ in range(factors if count > 1 else 0):
        one, other = rng.permutation(list(sizes))[:2].tolist()
        A, B = rng.normal(size=(3, sizes[one])), rng.normal(size=(3, sizes[other]))
        unit = gtsam.noiseModel.Unit.Create(3)
        graph.add(gtsam.JacobianFactor(one, A, other, B, rng.normal(size=3), unit))
        groups.append([one, other])
    return graph, sizes, groups


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 25),
    factors=st.integers(0, 40),
    by_qr=st.booleans(),
)
def test_they_are_blocks_of_the_dense_inverse_whatever_the_order(
    seed: int, count: int, factors: int, by_qr: bool
) -> None:
    rng = np.random.default_rng(seed)
    graph, sizes, groups = random_graph(rng, count, factors)
    keys = rng.permutation(list(sizes)).tolist()
    by = (gtsam.EliminateQR,) if by_qr else ()
    net = graph.eliminateSequential(gtsam.Ordering(keys), *by)
    H = graph.hessian(gtsam.Ordering(list(sizes)))[0]
    dense, starts = np.linalg.inv(H), np.cumsum([0, *sizes.values()])
    start = dict(zip(sizes, starts.tolist(), strict=False))
    for group, found in zip(groups, shared_covariances(net, groups), strict=True):
        at = np.concatenate([np.arange(start[key], start[key] + sizes[key]) for key in group])
        # Condition of H, some 1e3, times rounding.
        np.testing.assert_allclose(found, dense[np.ix_(at, at)], rtol=1e-9, atol=1e-12)


def test_a_chain_that_sees_one_landmark_is_cliques_of_three() -> None:
    """0 - 1 - 2, each connected to 3 as well."""
    root, first = cliques_of([(1, 3), (2, 3), (3,), ()])
    assert (root.frontal, root.separator, root.parent) == ((1, 2, 3), (), ROOT)
    assert (first.frontal, first.separator, first.parent) == ((0,), (1, 3), 0)


def test_variables_that_no_factor_connects_are_trees_of_their_own() -> None:
    assert [(each.frontal, each.parent) for each in cliques_of([(), ()])] == [
        ((1,), ROOT),
        ((0,), ROOT),
    ]


def test_variables_without_a_common_factor_have_no_covariance_here() -> None:
    graph = gtsam.GaussianFactorGraph()
    for k in range(2):
        unit = gtsam.noiseModel.Unit.Create(1)
        graph.add(gtsam.JacobianFactor(X(k), np.eye(1), np.zeros(1), unit))
    net = graph.eliminateSequential(gtsam.Ordering([X(0), X(1)]))
    with pytest.raises(KeyError):
        shared_covariances(net, [[X(0), X(1)]])
