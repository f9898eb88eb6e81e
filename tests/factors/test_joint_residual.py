"""Several residuals as one factor: the same error, the right derivatives."""

import gtsam
import numpy as np
import pytest

from l2m_factors import (
    Residual,
    V,
    X,
    assert_jacobians_match,
    drifting_fixed_axes_step,
    drifting_step,
    joint_residual,
)

NOISE = gtsam.noiseModel.Gaussian.Covariance(np.cov(np.random.default_rng(7).normal(size=(6, 40))))
STEPS = 3


def chain() -> gtsam.Values:
    rng, values = np.random.default_rng(3), gtsam.Values()
    for k in range(STEPS + 1):
        values.insert(X(k), gtsam.Pose3.Expmap(rng.normal(0, 0.5, 6)))
    values.insert(V(), rng.normal(size=6))
    return values


def steps() -> list[Residual]:
    """One along fixed axes, then two along those of the vehicle: they share poses and the drift."""
    rng, weights = np.random.default_rng(5), np.array([0.2, 0.3])
    step = gtsam.Pose3.Expmap(rng.normal(0, 0.5, 6))
    fixed = drifting_fixed_axes_step(0, step.rotation(), step.translation(), weights)
    return [fixed, *(drifting_step(k, step, weights) for k in range(1, STEPS))]


def test_one_factor_has_the_error_of_all() -> None:
    values = chain()
    each = sum(residual.factor(NOISE).error(values) for residual in steps())
    joint = joint_residual([residual.whitened(NOISE) for residual in steps()])
    assert (joint.size, len(joint.keys)) == (6 * STEPS, STEPS + 2)
    assert joint.factor().error(values) == pytest.approx(each, rel=1e-12)


def test_its_derivatives_are_those_of_finite_differences() -> None:
    joint = joint_residual([residual.whitened(NOISE) for residual in steps()])
    assert_jacobians_match(joint.factor(), chain())


def test_a_graph_of_it_has_the_linear_system_of_all() -> None:
    values = chain()
    apart, together = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for residual in steps():
        apart.add(residual.factor(NOISE))
    together.add(joint_residual([residual.whitened(NOISE) for residual in steps()]).factor())
    order = gtsam.Ordering(gtsam.KeyVector([*(X(k) for k in range(STEPS + 1)), V()]))
    systems = [graph.linearize(values).hessian(order) for graph in (apart, together)]
    for one, other in zip(*systems, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_white_residual_is_a_factor_of_its_own() -> None:
    """GTSAM's list of derivatives is filled block by block: it takes no slice."""
    for residual in steps():
        white = residual.whitened(NOISE).factor()
        assert white.error(chain()) == pytest.approx(residual.factor(NOISE).error(chain()))
        assert_jacobians_match(white, chain())
