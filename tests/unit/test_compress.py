"""Linear factors of fewer rows: the same quadratic."""

import gtsam
import numpy as np
import pytest

from l2m_factors import (
    BatchedReadings,
    D,
    M,
    T,
    block_factor,
    distortion_prior,
    map_weights_prior,
    uncertain_block_factor,
)
from l2m_gtsam.graph.compress import fewer_rows, linearised
from tests.factors.test_map_weights import features, whitenings, with_weights
from tests.factors.test_reading import as_magnetic
from tests.worlds import dipole_world, drive, random_sensors

COUNT = 60  # readings of each of two sensors


def graph_and_values() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Tall factors on two and three variables, and short ones that stay as they are."""
    world = dipole_world(1)
    readings = as_magnetic(drive(1, random_sensors(1, 2), world, count=COUNT, tilt=0.4))
    batch = BatchedReadings(world, readings)
    W = whitenings(1, 2 * COUNT)
    graph = gtsam.NonlinearFactorGraph()
    for start, tile, size in ((0, 7, 4), (30, 2, 6), (60, 2, 6), (117, 7, 4)):
        rows = np.arange(start, min(start + 30, 2 * COUNT))
        A = features(start, len(rows), size)
        graph.add(uncertain_block_factor(batch, rows, tile, A, W[rows]))
    graph.add(block_factor(batch, 1, W))
    graph.add(map_weights_prior({7: 4, 2: 6}, np.eye(10) + 0.1))
    graph.add(distortion_prior(0, np.eye(3), 0.3))
    return graph, with_weights(1, 2)


def random_step(values: gtsam.Values, rng: np.random.Generator) -> gtsam.VectorValues:
    step = values.zeroVectors()
    for key in (T(0), D(0), T(1), D(1), M(2), M(7)):
        part = gtsam.VectorValues()
        part.insert(key, rng.normal(size=len(step.at(key))))
        step.update(part)
    return step


def test_the_quadratic_is_the_same() -> None:
    graph, values = graph_and_values()
    whole, small = graph.linearize(values), linearised(graph, values)
    rng = np.random.default_rng(0)
    for _ in range(10):
        step = random_step(values, rng)
        # Orthogonal transformations: rounding.
        assert small.error(step) == pytest.approx(whole.error(step), rel=1e-11)


def test_the_optimum_and_the_information_are_the_same() -> None:
    graph, values = graph_and_values()
    whole, small = graph.linearize(values), linearised(graph, values)
    ordering = gtsam.Ordering()
    for key in (T(0), D(0), T(1), D(1), M(2), M(7)):
        ordering.push_back(key)
    (H, g), (H_small, g_small) = (each.hessian(ordering) for each in (whole, small))
    np.testing.assert_allclose(H_small, H, rtol=0, atol=1e-11 * np.abs(H).max())
    np.testing.assert_allclose(g_small, g, rtol=0, atol=1e-11 * np.abs(g).max())
    A, b = whole.jacobian(ordering)
    expected = np.linalg.lstsq(A, b, rcond=None)[0]
    found = small.eliminateSequential(ordering, gtsam.EliminateQR).optimize()
    step = np.concatenate([found.at(ordering.at(i)) for i in range(ordering.size())])
    # The condition of 1e5 of the system leaves this much.
    np.testing.assert_allclose(step, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_no_factor_has_many_more_rows_than_columns() -> None:
    graph, values = graph_and_values()
    small, whole = linearised(graph, values), graph.linearize(values)
    assert small.size() == whole.size()
    for index in range(small.size()):
        A, _ = small.at(index).jacobian()
        assert len(A) <= A.shape[1] + 1
        assert list(small.at(index).keys()) == list(whole.at(index).keys())


def test_a_short_factor_stays_as_it_is() -> None:
    rng = np.random.default_rng(2)
    factor = gtsam.JacobianFactor(
        T(0), rng.normal(size=(3, 3)), rng.normal(size=3), gtsam.noiseModel.Unit.Create(3)
    )
    assert fewer_rows(factor, [3]) is factor


def test_a_factor_without_information_does_not_matter() -> None:
    """Rows of zeros, as of readings of infinite variance."""
    unit = gtsam.noiseModel.Unit.Create(20)
    empty = gtsam.JacobianFactor(T(0), np.zeros((20, 3)), np.zeros(20), unit)
    A, b = fewer_rows(empty, [3]).jacobian()
    np.testing.assert_array_equal(A, 0)
    np.testing.assert_array_equal(b, 0)
