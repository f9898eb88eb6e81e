"""GTSAM's optimisers, and the Gauss-Newton steps after them."""

import gtsam
import numpy as np
import pytest

from l2m_gtsam.calibration.optimise import Ending, Optimizer, optimise, polish
from l2m_gtsam.data import FloatArray

X = gtsam.symbol("x", 0)


def arctangent() -> gtsam.NonlinearFactorGraph:
    """Return a graph with the error arctan(x), whose Gauss-Newton steps diverge from 1.4 on."""

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        x = values.atVector(X)
        if jacobians is not None:
            jacobians[0] = np.diag(1 / (1 + x**2))
        return np.arctan(x)

    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [X], error))
    return graph


def at(x: float) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X, np.array([x]))
    return values


def test_steps_that_go_uphill_are_refused() -> None:
    found = polish(arctangent(), at(2.0), 2)
    assert found.ending is Ending.UPHILL
    assert found.values.atVector(X)[0] == 2.0
    descended = optimise(arctangent(), at(2.0), Optimizer.LM, 50)
    assert descended.ending is Ending.TOLERANCE
    # The error x^2 / 2 falls by less than 1e-5 there.
    assert descended.values.atVector(X)[0] == pytest.approx(0.0, abs=5e-3)


def test_near_the_optimum_steps_go_on_to_where_the_gradient_vanishes() -> None:
    found = polish(arctangent(), at(0.1), 2)
    assert found.ending is Ending.TOLERANCE
    # A step from x leaves 2 x^3 / 3: 7e-4, then 2e-10.
    assert found.values.atVector(X)[0] == pytest.approx(0.0, abs=1e-9)
