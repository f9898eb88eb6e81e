"""Descents where Cholesky is refused or damping has grown, at once and step by step."""

from typing import Any

import gtsam
import numpy as np
import pytest

from l2m_gtsam.calibration.optimise import TOLERANCE, Ending
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.solver import (
    DAMPING,
    colamd_ordering,
    gauss_newton,
    levenberg_marquardt,
    stepwise_levenberg_marquardt,
)
from tests.drives.pose_chain import FAR_APART, chain
from tests.support.stepwise import completed


@pytest.mark.parametrize(("start", "step"), FAR_APART)
def test_where_cholesky_is_refused_descents_go_on_by_qr(
    start: list[float], step: list[float]
) -> None:
    """Poses away from where start and odometry have them come there."""
    graph, values, _ = chain(start, step)
    rng, begin = np.random.default_rng(2), gtsam.Values()
    for key in values.keys():  # noqa: SIM118 - GTSAM's values cannot be iterated
        begin.insert(key, values.atPose3(key).retract(0.1 * rng.normal(size=6)))
    found = levenberg_marquardt(graph, begin, colamd_ordering(graph), 50).values
    assert graph.error(found) < 1e-3
    found, _ = in_steps(graph, begin, 50)
    assert graph.error(found) < 1e-3


@pytest.mark.parametrize("begin_at", [0.5, 3.0])
def test_where_a_whole_step_overshoots_a_damped_one_is_made(begin_at: float) -> None:
    """From 3 on the tangent of an arc tangent leads to -9.5; from half it leads home.

    Factors' values of the step before are still there: the optimiser forgets its own.
    """
    keys = [gtsam.symbol("x", k) for k in range(100)]
    graph, begin = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def residual(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        at = values.atVector(this.keys()[0])
        if jacobians is not None:
            jacobians[0] = np.array([1 / (1 + at**2)])
        return np.asarray(np.arctan(at))

    for key in keys:
        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [key], residual))
        begin.insert(key, np.array([begin_at]))
    found = gauss_newton(graph, begin, colamd_ordering(graph), 50)
    assert found.ending is Ending.TOLERANCE
    assert graph.error(found.values) < 1e-4
    assert begin.atVector(keys[0])[0] == begin_at


@pytest.mark.parametrize("in_pieces", [False, True])
@pytest.mark.parametrize(
    ("solved", "then"), [(True, "MULTIFRONTAL_CHOLESKY"), (False, "MULTIFRONTAL_QR")]
)
def test_where_damping_has_grown_the_descent_goes_on_by_what_solves_it(
    in_pieces: bool, solved: bool, then: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 3 on, steps along the tangent of an arc tangent only overshoot; one damped step is made.

    A second variable that no factor holds is what Cholesky refuses.
    """
    x, y = gtsam.symbol("x", 0), gtsam.symbol("y", 0)

    def residual(
        this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        at = values.atVector(x)
        if jacobians is not None:
            jacobians[0] = np.array([1 / (1 + at**2)])
            jacobians[1] = np.zeros((1, 1))
        return np.asarray(np.arctan(at))

    graph, begin = gtsam.NonlinearFactorGraph(), gtsam.Values()
    unit = gtsam.noiseModel.Unit.Create(1)
    graph.add(gtsam.CustomFactor(unit, [x, y], residual))
    if solved:
        graph.add(gtsam.PriorFactorVector(y, np.zeros(1), unit))
    begin.insert(x, np.array([3.0]))
    begin.insert(y, np.zeros(1))
    solvers: list[str] = []

    def recorded(*args: Any) -> gtsam.LevenbergMarquardtOptimizer:
        solvers.append(args[2].getLinearSolverType())
        return optimizer(*args)

    optimizer = gtsam.LevenbergMarquardtOptimizer
    monkeypatch.setattr(gtsam, "LevenbergMarquardtOptimizer", recorded)
    if in_pieces:
        in_steps(graph, begin, 50, close=1.0)
    else:
        levenberg_marquardt(graph, begin, colamd_ordering(graph), 50, close=1.0)
    assert solvers == ["MULTIFRONTAL_CHOLESKY", then]


def in_steps(
    graph: gtsam.NonlinearFactorGraph, begin: gtsam.Values, most: int, close: float = TOLERANCE
) -> tuple[gtsam.Values, int]:
    """Return values that are solved for step by step, and how often the work was interrupted."""
    found, pauses = completed(
        stepwise_levenberg_marquardt(graph, begin, colamd_ordering(graph), most, close)
    )
    return found.values, pauses


@pytest.mark.parametrize("most", [1, 3, 50])
def test_step_by_step_it_is_the_descent_of_gtsams_own_loop(most: int) -> None:
    graph, values, _ = chain([0.1] * 6, [0.02] * 6)
    rng, begin = np.random.default_rng(4), gtsam.Values()
    for key in values.keys():  # noqa: SIM118 - GTSAM's values cannot be iterated
        begin.insert(key, values.atPose3(key).retract(0.3 * rng.normal(size=6)))
    found, pauses = in_steps(graph, begin, most)
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(most)
    params.setAbsoluteErrorTol(TOLERANCE)
    params.setRelativeErrorTol(TOLERANCE)
    params.setlambdaInitial(DAMPING)
    params.setlambdaLowerBound(DAMPING)
    params.setOrdering(colamd_ordering(graph))
    at_once = gtsam.LevenbergMarquardtOptimizer(graph, begin, params).optimize()
    assert found.equals(at_once, 1e-12)
    assert pauses == most or (most == 50 and 3 <= pauses < 20)
