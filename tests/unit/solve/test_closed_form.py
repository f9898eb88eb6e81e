"""Closed forms against references written out the long way, and against their own claims."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from l2m_gtsam.data import Distortion, FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.solve.closed_form import (
    ClosedFormOptions,
    Method,
    RidgeRule,
    Weighting,
    fit_distortion,
    generalised_cross_validation,
    l_curve,
    ridge_path,
    ridge_unit,
    row_weights,
)


def pairs(seed: int, count: int, noise: float) -> tuple[FloatArray, FloatArray, Distortion]:
    rng = np.random.default_rng(seed)
    b = np.array([20.0, 5.0, -40.0]) + rng.normal(0, [15, 15, 5], (count, 3))
    truth = Distortion(np.eye(3) + rng.normal(0, 0.1, (3, 3)), rng.normal(0, 20, 3))
    return b, truth.apply(b) + noise * rng.normal(size=(count, 3)), truth


@pytest.mark.parametrize("method", list(Method))
@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_noiseless_pairs_give_the_truth(method: Method, seed: int) -> None:
    """But for what the ridge takes of C - I: ``l (S + l)^-1`` of it, for a spread S of the field.

    It is some 1e-9, and several times that along axes that vary little. The rest is rounding.
    """
    b, z, truth = pairs(seed, 40, 0.0)
    weights = np.random.default_rng(seed).uniform(0.1, 5, 40)
    fit = fit_distortion(b, z, weights, ClosedFormOptions(method=method))
    w = weights if method is Method.W_RRTLS else np.ones(40)
    mean = np.average(b, axis=0, weights=w)
    S = (w[:, None] * (b - mean)).T @ (b - mean)
    ridge = fit.ridge * ridge_unit(b, w) * np.eye(3)
    taken = np.linalg.solve(S + ridge, ridge @ (truth.C - np.eye(3)).T).T
    assert np.abs(taken).max() < 1e-8
    np.testing.assert_allclose(fit.distortion.C, truth.C - taken, atol=1e-13)
    np.testing.assert_allclose(fit.distortion.H, truth.H + taken @ mean, atol=1e-11)


def test_ols_is_numpys_least_squares() -> None:
    b, z, _ = pairs(1, 60, 0.5)
    fit = fit_distortion(b, z, np.ones(60), ClosedFormOptions(method=Method.OLS))
    reference = np.linalg.lstsq(np.hstack([b, np.ones((60, 1))]), z)[0]
    np.testing.assert_allclose(fit.distortion.C, reference[:3].T, rtol=1e-9)
    np.testing.assert_allclose(fit.distortion.H, reference[3], rtol=1e-8)


def test_tls_minimises_perpendicular_distances() -> None:
    """Its optimum: errors of both sides of a pair, ``e = C b + H - z``, cost e (I + C C^T)^-1 e."""
    b, z, truth = pairs(2, 50, 0.8)
    fit = fit_distortion(b, z, np.ones(50), ClosedFormOptions(method=Method.TLS))

    def cost(x: FloatArray) -> float:
        C, H = x[:9].reshape(3, 3), x[9:]
        e = b @ C.T + H - z
        return float(np.sum(e * np.linalg.solve(np.eye(3) + C @ C.T, e.T).T))

    at_fit = fit.distortion.vector()
    reference = minimize(cost, truth.vector(), method="BFGS", options={"gtol": 1e-8})
    # BFGS with numeric gradients stops about 1e-7 above the minimum.
    assert cost(at_fit) <= reference.fun * (1 + 1e-6)
    np.testing.assert_allclose(at_fit[:9], reference.x[:9], atol=1e-4)


def test_weighted_ridge_minimises_its_stated_objective() -> None:
    """w-RRTLS without noise on either side to truncate is weighted ridge regression around I."""
    b, z, _ = pairs(3, 30, 0.0)
    rng = np.random.default_rng(3)
    w = rng.uniform(0.1, 4.0, 30)
    strength = 0.3
    fit = fit_distortion(b, z, w, ClosedFormOptions(ridge_strength=strength))
    lam = strength * ridge_unit(b, w)
    A = np.hstack([b, np.ones((30, 1))])
    normal = A.T @ (w[:, None] * A) + lam * np.diag([1.0, 1, 1, 0])
    right = A.T @ (w[:, None] * z) + lam * np.vstack([np.eye(3), np.zeros((1, 3))])
    reference = np.linalg.solve(normal, right)
    np.testing.assert_allclose(fit.distortion.C, reference[:3].T, atol=1e-9)
    np.testing.assert_allclose(fit.distortion.H, reference[3], atol=1e-7)


def test_weights_follow_the_good_readings() -> None:
    """Half of the readings are 50 times noisier: weighting them down must help much."""
    better = []
    for seed in range(20):
        b, z, truth = pairs(seed, 200, 0.1)
        sigma = np.where(np.arange(200) % 2 == 0, 0.1, 5.0)
        z = z + np.random.default_rng(seed + 1000).normal(size=z.shape) * sigma[:, None]
        w = row_weights(sigma**2, 0.1**2, Weighting.LIKELIHOOD)
        error = [
            np.linalg.norm(
                fit_distortion(b, z, w, ClosedFormOptions(method=m)).distortion.C - truth.C
            )
            for m in (Method.W_RRTLS, Method.RRTLS)
        ]
        better.append(error[1] / error[0])
    assert np.median(better) > 5  # noise ratio 50 in half of the rows gives about 20


def test_planar_motion_keeps_the_open_column_at_the_nominal_one() -> None:
    """A vertical field that never varies leaves C's third column to C0, whatever the method."""
    b, _, truth = pairs(5, 100, 0.0)
    b[:, 2] = -40.0
    z = truth.apply(b)
    for method in Method:
        fit = fit_distortion(b, z, np.ones(100), ClosedFormOptions(method=method))
        np.testing.assert_allclose(fit.distortion.C[:, :2], truth.C[:, :2], atol=1e-8)
        np.testing.assert_allclose(fit.distortion.C[:, 2], [0, 0, 1], atol=1e-6)
        np.testing.assert_allclose(fit.distortion.apply(b), z, atol=1e-6)


def test_too_few_readings_are_refused() -> None:
    with pytest.raises(CalibrationError, match="3 readings cannot determine"):
        fit_distortion(np.eye(3), np.eye(3), np.ones(3), ClosedFormOptions())


def test_published_weights_are_the_variance_to_the_power_minus_two() -> None:
    v = np.array([0.5, 2.0])
    np.testing.assert_allclose(row_weights(v, 9.0, Weighting.PAPER), v**-2)
    np.testing.assert_allclose(row_weights(v, 9.0, Weighting.LIKELIHOOD), 1 / (v + 9.0))
    assert np.ptp(row_weights(np.zeros(3), 1.0, Weighting.PAPER)) == 0


def ill_posed(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Regressors with one direction 300 times weaker than the others, under noise."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(100, 3)) * [10.0, 10.0, 0.03]
    A = rng.normal(size=(3, 3)) * 0.1
    return X, X @ A + rng.normal(0, 0.5, (100, 3)), A


@pytest.mark.parametrize("rule", [RidgeRule.GCV, RidgeRule.L_CURVE])
def test_chosen_ridges_beat_no_ridge_on_ill_posed_data(rule: RidgeRule) -> None:
    gains = []
    for seed in range(30):
        X, Y, A = ill_posed(seed)
        path = ridge_path(X, Y)
        lam = generalised_cross_validation(path, 100) if rule is RidgeRule.GCV else l_curve(path)
        ridge = np.linalg.solve(X.T @ X + lam * np.eye(3), X.T @ Y)
        plain = np.linalg.lstsq(X, Y)[0]
        gains.append(np.linalg.norm(plain - A) / np.linalg.norm(ridge - A))
    assert np.median(gains) > 3  # the weak direction's error is 0.5 / (0.03 * 10) = 1.7 for 0.1


def test_ridge_path_agrees_with_solving_each_ridge() -> None:
    X, Y, _ = ill_posed(0)
    path = ridge_path(X, Y)
    for k in (40, 160, 250):
        lam = path.strength[k]
        A = np.linalg.solve(X.T @ X + lam * np.eye(3), X.T @ Y)
        hat = X @ np.linalg.solve(X.T @ X + lam * np.eye(3), X.T)
        assert path.residual[k] == pytest.approx(np.sum((Y - X @ A) ** 2), rel=1e-8)
        assert path.size[k] == pytest.approx(np.sum(A**2), rel=1e-6)
        assert path.freedom[k] == pytest.approx(np.trace(hat), rel=1e-6)


def test_gcv_leaves_well_posed_data_alone() -> None:
    b, z, _ = pairs(7, 300, 0.3)
    free = fit_distortion(b, z, np.ones(300), ClosedFormOptions(method=Method.TLS))
    gcv = ClosedFormOptions(method=Method.RRTLS, ridge=RidgeRule.GCV)
    ridged = fit_distortion(b, z, np.ones(300), gcv)
    assert ridged.ridge < 1e-2
    np.testing.assert_allclose(ridged.distortion.C, free.distortion.C, atol=5e-3)  # its sigma
