import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps import dense_gp
from l2m_gtsam.maps.dense_gp import DenseGP, DenseGPOptions
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters
from l2m_gtsam.maps.training import ThinningOptions
from tests.support.central_differences import slopes
from tests.worlds.exact import dipole_world

GIVEN = KernelHyperparameters(length_scale=0.8, signal=4.0, noise=0.2)
OPTIONS = DenseGPOptions(hyperparameters=GIVEN, thinning=ThinningOptions(spacing=0))


def readings(count: int = 200) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(4)
    points = rng.uniform([-2, -2, 0.2], [2, 2, 0.8], (count, 3))
    field, _ = dipole_world(1).field_and_gradient(points)
    return points, field + rng.normal(0, GIVEN.noise, field.shape)


def queries(count: int = 150) -> FloatArray:
    return np.random.default_rng(5).uniform([-3, -3, 0], [3, 3, 1.5], (count, 3))


def test_mean_and_variance_are_those_of_scikit_learn() -> None:
    points, field = readings()
    kernel = ConstantKernel(GIVEN.signal**2) * RBF(GIVEN.length_scale)
    peer = GaussianProcessRegressor(kernel, alpha=GIVEN.noise**2, optimizer=None)
    peer.fit(points, field - field.mean(axis=0))
    mean, std = peer.predict(queries(), return_std=True)
    ours = DenseGP.fit(points, field, OPTIONS)
    found, _ = ours.field_and_gradient(queries())
    # Two factorisations of a matrix of condition 1e5: digits end near 1e-11 of the signal.
    np.testing.assert_allclose(found, field.mean(axis=0) + mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.variance(queries()), std**2, rtol=0, atol=1e-9)


def test_the_gradient_is_the_derivative_of_the_field() -> None:
    ours = DenseGP.fit(*readings(), OPTIONS)
    _, gradient = ours.field_and_gradient(queries())
    expected = slopes(lambda x: ours.field_and_gradient(x)[0], queries(), 1e-4)
    # step^2 / 6 of the third derivative (100 uT/m^3) and rounding 1e-12 uT over the step
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-6)


def test_inside_is_near_a_reading() -> None:
    points, field = readings()
    ours = DenseGP.fit(points, field, OPTIONS)
    sample = ours.query(queries())
    distance = np.linalg.norm(queries()[:, None] - points, axis=-1).min(axis=1)
    np.testing.assert_array_equal(sample.inside, distance <= 0.83 * GIVEN.length_scale)
    assert 0 < sample.inside.sum() < len(sample.inside)
    assert np.isnan(sample.field[~sample.inside]).all()
    assert np.isfinite(sample.field[sample.inside]).all()


def test_one_reading_explains_half_of_the_variance_at_the_default_reach() -> None:
    """The reason of the default."""
    reach = DenseGPOptions().reach
    assert np.exp(-(reach**2)) == pytest.approx(0.5, abs=5e-3)  # 0.83 is sqrt(log 2) to two digits


def test_no_points_give_no_answers() -> None:
    sample = DenseGP.fit(*readings(), OPTIONS).query(np.empty((0, 3)))
    assert sample.field.shape == (0, 3)
    assert sample.gradient.shape == (0, 3, 3)
    assert sample.inside.shape == (0,)


def test_too_many_readings_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense_gp, "MOST_ROWS", 100)
    with pytest.raises(MapError, match="at most 100 training readings after thinning, got 200"):
        DenseGP.fit(*readings(), OPTIONS)
