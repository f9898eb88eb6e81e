"""Fits of models against references written out the long way, and against their own sigmas."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import toeplitz
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.sensor_models import Coefficients, Model, Samples
from l2m_gtsam.solve.model_comparison import correlation_of
from l2m_gtsam.solve.model_fits import Fit, compress, fit_model, inflation, spread_of
from tests.drives.model import NOISE, Setting, coefficients, drawn, field, times

LINEAR = [model for model in Model if model not in (Model.OFFSET, Model.SCALE)]
NESTED = [
    (Model.OFFSET, Model.SCALE),
    (Model.SCALE, Model.FULL),
    (Model.FULL, Model.REGRESSORS),
    (Model.FULL, Model.EDDY),
    (Model.REGRESSORS, Model.ALL),
    (Model.EDDY, Model.ALL),
]


def weighted(samples: Samples, seed: int = 0) -> Samples:
    """The same with weights over two decades."""
    weights = 10 ** np.random.default_rng(seed).uniform(-1, 1, len(samples))
    return replace(samples, weights=weights)


def fit(model: Model, samples: Samples) -> Fit:
    return fit_model(model, compress(samples))


def dense(model: Model, samples: Samples) -> FloatArray:
    """The weighted columns of a linear model, neither centred nor scaled."""
    parts = [np.ones((len(samples), 1)), samples.b]
    parts += [samples.q] if model.has_regressors else []
    parts += [samples.db_dt] if model.has_eddy else []
    return np.asarray(np.sqrt(samples.weights)[:, None] * np.hstack(parts))


def rows(model: Model, found: Coefficients) -> FloatArray:
    """Coefficients in the order of the dense columns."""
    parts = [found.H[None], found.C.T]
    parts += [found.h] if model.has_regressors else []
    parts += [found.E.T] if model.has_eddy else []
    return np.vstack(parts)


def ratios(found: Coefficients, truth: Coefficients, sigma: Coefficients) -> FloatArray:
    """Errors in sigmas of what a model does not fix."""
    error = np.concatenate([(found.C - truth.C).ravel(), found.H - truth.H])
    sigmas = np.concatenate([sigma.C.ravel(), sigma.H])
    for part in ("h", "E"):
        error = np.append(error, getattr(found, part) - getattr(truth, part))
        sigmas = np.append(sigmas, getattr(sigma, part))
    return np.asarray(error[sigmas > 0] / sigmas[sigmas > 0])


@pytest.mark.parametrize("model", list(Model))
@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_exact_readings_give_the_truth(model: Model, seed: int) -> None:
    """Gauss-Newton ends at steps of 1e-10, times fields of 50 uT."""
    case = drawn(model, seed, Setting(readings=60, noise=1e-13))
    found = fit(model, weighted(case.samples)).coefficients
    for part, tolerance in {"C": 1e-9, "H": 1e-7, "h": 1e-9, "E": 1e-10}.items():
        np.testing.assert_allclose(
            getattr(found, part), getattr(case.truth, part), atol=tolerance, err_msg=part
        )


@pytest.mark.parametrize("model", LINEAR)
def test_linear_models_are_numpys_least_squares(model: Model) -> None:
    """Both keep ten digits: the columns are conditioned to some 1e3."""
    samples = weighted(drawn(Model.ALL, 1).samples)
    X, Z = dense(model, samples), np.sqrt(samples.weights)[:, None] * samples.z
    reference, left = np.linalg.lstsq(X, Z)[:2]
    found = fit(model, samples)
    np.testing.assert_allclose(rows(model, found.coefficients), reference, rtol=1e-8, atol=1e-10)
    assert found.squares == pytest.approx(left.sum(), rel=1e-10)
    assert found.parameters == 3 * X.shape[1]
    assert found.variance == pytest.approx(left.sum() / (Z.size - 3 * X.shape[1]), rel=1e-10)


@pytest.mark.parametrize("model", LINEAR)
def test_sigmas_are_those_of_the_normal_equations(model: Model) -> None:
    samples = weighted(drawn(Model.ALL, 2, Setting(readings=200)).samples)
    X, packed, found = dense(model, samples), compress(samples), fit(model, samples)
    inverse = np.linalg.inv(X.T @ X)
    independent = spread_of(found, packed, np.eye(len(packed.R)))
    expected = np.sqrt(found.variance * np.diag(inverse))[:, None] * np.ones(3)
    np.testing.assert_allclose(rows(model, independent.sigma), expected, rtol=1e-6)
    assert independent.freedom == pytest.approx(found.parameters)


def test_sigmas_under_correlation_are_the_sandwich() -> None:
    """Slow columns, so that correlation raises every variance and none is held at independence."""
    samples = weighted(drawn(Model.ALL, 2, Setting(readings=200)).samples)
    samples = replace(samples, weights=np.ones(200), q=np.linspace(-1, 1, 200)[:, None] ** 2)
    correlation = 0.9 * 0.5 ** np.arange(200.0)
    correlation[0] = 1.0
    X, packed, found = dense(Model.ALL, samples), compress(samples), fit(Model.ALL, samples)
    middle, inverse = X.T @ toeplitz(correlation) @ X, np.linalg.inv(X.T @ X)
    expected = np.sqrt(found.variance * np.diag(inverse @ middle @ inverse))
    found_spread = spread_of(found, packed, inflation(packed, correlation))
    assert np.linalg.eigvalsh(packed.Q.T @ toeplitz(correlation) @ packed.Q).min() > 1
    np.testing.assert_allclose(rows(Model.ALL, found_spread.sigma)[:, 0], expected, rtol=1e-6)
    assert found_spread.freedom == pytest.approx(3 * np.trace(inverse @ middle))


def test_the_rotation_is_that_of_wahbas_problem() -> None:
    samples = weighted(drawn(Model.FULL, 3).samples)
    b, z = (
        each - np.average(each, axis=0, weights=samples.weights) for each in (samples.b, samples.z)
    )
    reference = Rotation.align_vectors(z, b, weights=samples.weights)[0].as_matrix()
    found = fit(Model.OFFSET, samples).coefficients
    np.testing.assert_allclose(found.C, reference, atol=1e-9)
    left = np.average(found.residual(samples), axis=0, weights=samples.weights)
    np.testing.assert_allclose(left, 0, atol=1e-12)  # the offset is the best one


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(3))
def test_no_other_scaled_rotation_leaves_less(mirror: float, seed: int) -> None:
    """Of readings that have a full C; a sensor with a reversed axis has scales below zero."""
    samples = weighted(drawn(Model.FULL, seed, Setting(readings=100)).samples)
    samples = replace(samples, z=samples.z * [1, 1, mirror])
    found = fit(Model.SCALE, samples)
    root = np.sqrt(samples.weights)[:, None]
    b, z = (
        root * (each - np.average(each, axis=0, weights=samples.weights))
        for each in (samples.b, samples.z)
    )

    def cost(x: FloatArray) -> float:
        C = x[3:, None] * Rotation.from_rotvec(x[:3]).as_matrix()
        return float(np.sum((z - b @ C.T) ** 2))

    rng = np.random.default_rng(seed)
    starts = [np.append(rng.normal(0, 1.5, 3), rng.choice([-1, 1], 3)) for _ in range(8)]
    least = min(minimize(cost, start, method="BFGS").fun for start in starts)
    assert found.squares <= least * (1 + 1e-9)
    np.testing.assert_allclose(
        found.coefficients.C @ found.coefficients.C.T,
        np.diag(np.sum(found.coefficients.C**2, axis=1)),
        atol=1e-12,
    )
    assert np.sign(np.linalg.det(found.coefficients.C)) == mirror


@pytest.mark.parametrize("smaller", NESTED)
@settings(max_examples=5)
@given(seed=st.integers(0, 10_000))
def test_a_larger_model_leaves_no_more(smaller: tuple[Model, Model], seed: int) -> None:
    samples = weighted(drawn(Model.ALL, seed, Setting(readings=80)).samples)
    small, large = (fit(model, samples) for model in smaller)
    assert large.squares <= small.squares * (1 + 1e-9)
    assert large.parameters > small.parameters


def test_sums_of_squares_are_those_of_the_residuals() -> None:
    samples = weighted(drawn(Model.FULL, 4).samples)
    for model in Model:
        found = fit(model, samples)
        e = found.coefficients.residual(samples)
        expected = np.sum(samples.weights[:, None] * e**2)
        assert found.squares == pytest.approx(expected, rel=1e-9)


@given(factor=st.sampled_from([1e-6, 1e-3, 1e4]), zero=st.floats(-100, 100))
def test_units_of_a_number_do_not_matter(factor: float, zero: float) -> None:
    """Kelvin or Celsius, mA or A: h follows, and the offset, which is that at zero."""
    samples = drawn(Model.ALL, 5, Setting(readings=80)).samples
    plain = fit(Model.ALL, samples).coefficients
    other = fit(Model.ALL, replace(samples, q=factor * (samples.q + zero))).coefficients
    np.testing.assert_allclose(other.h * factor, plain.h, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(other.H, plain.H - zero * plain.h[0], atol=1e-6)
    np.testing.assert_allclose(other.C, plain.C, atol=1e-9)
    np.testing.assert_allclose(other.E, plain.E, atol=1e-9)


def test_a_current_that_never_changes_tells_nothing_of_its_field() -> None:
    samples = drawn(Model.FULL, 6).samples
    samples = replace(samples, q=np.full((len(samples), 1), 5.1))
    packed, found = compress(samples), fit(Model.REGRESSORS, samples)
    spread = spread_of(found, packed, np.eye(len(packed.R)))
    assert found.parameters == fit(Model.FULL, samples).parameters == 12
    np.testing.assert_array_equal(found.coefficients.h, 0)
    assert np.isinf(spread.sigma.h).all()
    assert np.isinf(spread.sigma.H).all()  # known is only H + 5.1 h
    assert np.isfinite(spread.sigma.C).all()


def test_what_the_field_does_not_tell_stays_at_the_rotation() -> None:
    """A vehicle that never tilts under a constant vertical field: the third column of C is open."""
    case = drawn(Model.OFFSET, 7)
    b = case.samples.b.copy()
    b[:, 2] = -42.0
    z = b @ case.truth.C.T + np.random.default_rng(0).normal(0, NOISE, b.shape)
    samples = replace(case.samples, b=b, z=z)
    packed, found = compress(samples), fit(Model.FULL, samples)
    spread = spread_of(found, packed, np.eye(len(packed.R)))
    assert found.parameters == 9
    np.testing.assert_array_equal(np.isinf(spread.sigma.C), np.tile([False, False, True], (3, 1)))
    rotation = fit(Model.OFFSET, samples).coefficients.C
    np.testing.assert_allclose(found.coefficients.C[:, 2], rotation[:, 2], atol=1e-12)


def test_a_parked_vehicle_tells_the_offset_only() -> None:
    case = drawn(Model.OFFSET, 8)
    still = np.tile([20.0, 0.0, -42.0], (len(case.samples), 1))
    samples = replace(case.samples, b=still, db_dt=0 * still, q=0 * case.samples.q)
    for model in Model:
        found = fit(model, samples)
        assert found.parameters == 3
        left = found.coefficients.residual(samples)
        np.testing.assert_allclose(left.mean(axis=0), 0, atol=1e-10)


def test_a_clock_that_is_off_looks_like_eddy_currents() -> None:
    """Readings of 10 ms after their stamps: E = tau C up to the field's second derivative."""
    tau, t = 0.01, times(400)
    truth = coefficients(Model.FULL, 9)
    late = field(t + tau, 9) @ truth.C.T + truth.H
    samples = replace(drawn(Model.FULL, 9).samples, z=late)
    E = fit(Model.EDDY, samples).coefficients.E
    np.testing.assert_allclose(E, tau * truth.C, atol=0.02 * tau)


@pytest.mark.parametrize("model", [Model.OFFSET, Model.SCALE, Model.ALL])
@pytest.mark.parametrize("map_error", [0.0, NOISE])
def test_errors_are_as_large_as_their_sigmas(model: Model, map_error: float) -> None:
    """Also where the map's errors last for 10 readings, which counted as independent would not do.

    60 drives with at least six parameters give the ratio to 5 % or so; estimated correlations are
    too short, and those of 400 readings give sigmas that are a sixth too small.
    """
    found: list[float] = []
    naive: list[float] = []
    for seed in range(60):
        case = drawn(model, seed, Setting(map_error=map_error))
        packed = compress(case.samples)
        best, largest = fit_model(model, packed), fit_model(Model.ALL, packed)
        root = np.sqrt(case.samples.weights)[:, None]
        correlation = correlation_of(root * largest.coefficients.residual(case.samples))
        for into, spread in (
            (found, inflation(packed, correlation)),
            (naive, np.eye(len(packed.R))),
        ):
            sigma = spread_of(best, packed, spread).sigma
            into.append(float(np.mean(ratios(best.coefficients, case.truth, sigma) ** 2)))
    lower, upper = (0.9, 1.1) if map_error == 0 else (0.95, 1.3)
    assert lower < np.sqrt(np.mean(found)) < upper
    assert (np.sqrt(np.mean(naive)) > 1.8) == (map_error > 0)
