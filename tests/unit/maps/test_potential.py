"""The reduced-rank potential: derivatives, order of waves, and the covariance it stands for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters, smallest_waves
from tests.support.central_differences import slopes

LOW, HIGH = np.array([-1.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.5])
PRIOR = PotentialHyperparameters(sigma=20.0, length=0.8)


@given(st.integers(0, 2**31))
def test_gradient_is_that_of_the_field_and_symmetric(seed: int) -> None:
    rng = np.random.default_rng(seed)
    basis = PotentialBasis.over(LOW, HIGH, PRIOR, 60)
    points, weights = rng.uniform(LOW, HIGH, (4, 3)), rng.normal(size=len(basis))
    _, gradient = basis.field_and_gradient(points, weights)
    expected = slopes(lambda x: basis.field_and_gradient(x, weights)[0], points, 1e-5)
    # Central differences err by h^2 w^3, some 1e-7 here.
    np.testing.assert_allclose(expected, gradient, atol=1e-5)
    curl = gradient - gradient.transpose(0, 2, 1)
    assert np.abs(curl).max() < 1e-12 * np.abs(gradient).max()


@given(seed=st.integers(0, 2**31), count=st.integers(0, 4))
def test_field_features_and_slopes_are_of_one_field(seed: int, count: int) -> None:
    """Each is computed by itself; rounding of sums over 63 weights."""
    rng = np.random.default_rng(seed)
    basis = PotentialBasis.over(LOW, HIGH, PRIOR, 60)
    points, weights = rng.uniform(LOW, HIGH, (count, 3)), rng.normal(size=len(basis))
    features, by_x = basis.features(points), basis.slopes(points)
    field, gradient = basis.field_and_gradient(points, weights)
    np.testing.assert_allclose(features @ weights, field, rtol=0, atol=1e-10)
    np.testing.assert_allclose(by_x @ weights, gradient, rtol=0, atol=1e-10)
    by_features = rng.normal(size=features.shape)
    expected = np.einsum("nam,naim->ni", by_features, by_x)
    np.testing.assert_allclose(basis.by_points(points, by_features), expected, rtol=0, atol=1e-10)


def test_weights_and_features_of_another_size_are_refused() -> None:
    basis, points = PotentialBasis.over(LOW, HIGH, PRIOR, 60), np.zeros((2, 3))
    with pytest.raises(ValueError, match=r"^weights: \(5,\); needed is \(63,\)$"):
        basis.field_and_gradient(points, np.ones(5))
    with pytest.raises(ValueError, match=r"^by_features: \(1, 3, 63\); needed is \(2, 3, 63\)$"):
        basis.by_points(points, np.ones((1, 3, 63)))


@given(st.tuples(*[st.floats(0.5, 20.0)] * 3), st.integers(1, 25))
def test_waves_are_the_smallest(size: tuple[float, ...], count: int) -> None:
    edges = np.array(size)
    found = np.sum(smallest_waves(edges, count) ** 2, axis=1)
    numbers = np.stack(np.meshgrid(*[np.arange(1, count + 1)] * 3, indexing="ij"), -1)
    everything = np.sort(np.sum((np.pi / edges * numbers) ** 2, axis=-1).ravel())
    np.testing.assert_allclose(found, everything[:count], rtol=1e-12)


def test_covariance_is_that_of_the_kernel() -> None:
    """Away from the faces the features' covariance is minus the Hessian of the kernel."""
    big = PotentialBasis.over(np.full(3, -4.0), np.full(3, 4.0), PRIOR, 6000)
    x = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.4]])
    F = big.features(x)[:, :, 3:]
    found = np.einsum("im,m,jm->ij", F[0], big.variance[3:], F[1])
    d, square = x[0] - x[1], PRIOR.length**2
    kernel = PRIOR.sigma**2 * np.exp(-0.5 * d @ d / square)
    expected = kernel * (np.eye(3) / square - np.outer(d, d) / square**2)
    # What waves beyond 6,000 hold, relative to the variance at one place.
    assert found == pytest.approx(expected, abs=0.01 * PRIOR.sigma**2 / square)
