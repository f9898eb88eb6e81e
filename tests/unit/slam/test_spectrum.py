"""What is learnt of field and noise from readings at known places."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import Bounds, minimize
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise
from l2m_gtsam.slam.unknown_field.spectrum import (
    FIRST,
    HIGHEST,
    LOWEST,
    LearntReadings,
    SpectrumLikelihood,
    learnt_spectrum,
)

STRENGTH, LENGTH = 8.0, 1.0
COUNT, APART_M = 250, 0.4
WAVES = 200


def slow_noise(noise: SensorNoise, path_m: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return white noise and a slow error along a path in uT, shape (N, 3)."""
    alike = np.exp(-np.abs(np.subtract.outer(path_m, path_m)) / noise.slow_m)
    root = np.linalg.cholesky(alike + 1e-9 * np.eye(len(path_m)))
    white, slow = rng.normal(size=(2, len(path_m), 3))
    return np.asarray(noise.white_ut * white + noise.slow_ut * root @ slow)


def read(noise: SensorNoise, C: FloatArray, seed: int) -> LearntReadings:
    """Return readings along laps of 6 x 2 m in a field that the model holds."""
    rng, at = np.random.default_rng(seed), np.linspace(0, 8 * np.pi, COUNT)
    x = np.column_stack([3 * np.cos(at), np.sin(at), np.zeros(COUNT)])
    x += rng.normal(0, 0.15, x.shape) * [1, 1, 0]
    R = Rotation.from_euler("z", at[:, None]).as_matrix()
    prior = PotentialHyperparameters(sigma=STRENGTH * LENGTH, length=LENGTH)
    basis = PotentialBasis.over(x.min(axis=0) - 2, x.max(axis=0) + 2, prior, 200)
    weights = np.sqrt(basis.variance) * rng.normal(size=len(basis))
    path_m = APART_M * np.arange(COUNT, dtype=np.float64)
    b = np.einsum("nji,nj->ni", R, basis.features(x) @ weights)
    return LearntReadings(x, R, b @ C.T + slow_noise(noise, path_m, rng), path_m)


def test_lasting_noise_is_told_from_white_noise_and_from_the_field() -> None:
    """Of some sixty independent values a standard deviation is known to a tenth; three times it."""
    true = SensorNoise(1.5, 0.1, 3.0)
    found = learnt_spectrum(read(true, np.eye(3), 0), 0.01, 1.0, WAVES)
    assert found.noise.ut == pytest.approx(true.ut, rel=0.35)
    assert found.noise.white_ut == pytest.approx(true.white_ut, rel=0.5)
    assert true.slow_m / 2.5 < found.noise.slow_m < 2.5 * true.slow_m
    assert found.prior.length == pytest.approx(LENGTH, rel=0.2)


def test_steel_beside_the_sensor_is_no_noise() -> None:
    """With C free the noise is found as without steel; with C held it would be many times that."""
    true, C = SensorNoise(0.3, 0.5, 3.0), np.diag([1.3, 0.8, 1.0])
    readings = read(true, C, 1)
    free, held = (learnt_spectrum(readings, each, 1.0, WAVES) for each in (0.3, 1e-3))
    assert free.noise.ut == pytest.approx(true.ut, rel=0.5)
    assert free.log_likelihood > held.log_likelihood + 50
    # The correction undoes it. A factor of all three axes is one of the field's strength, too; a
    # tenth is what noise of 0.3 uT and a prior of 0.3 leave of the rest.
    rest = free.correction[:9].reshape(3, 3) @ C
    np.testing.assert_allclose(rest / np.cbrt(np.linalg.det(rest)), np.eye(3), atol=0.1)


def test_scaling_all_readings_down_is_no_gain() -> None:
    """A and h are integrated out with their volume: without it A = 0 explains all readings."""
    true = SensorNoise(0.5, 0.5, 3.0)
    readings = read(true, np.eye(3), 2)
    level = np.einsum("nij,nj->ni", readings.R, readings.field)
    unit = (level - level.mean(axis=0)).std()  # of the strengths below
    at = np.log([STRENGTH / unit, LENGTH, true.ut / unit, 1.0, true.slow_m])
    tight, wide = (
        SpectrumLikelihood(readings, each, 1.0, WAVES).log_likelihood(at) for each in (0.03, 3.0)
    )
    assert wide < tight


@pytest.mark.parametrize("angle", [40, 70, 110])
def test_the_likelihood_does_not_jump_where_the_sensor_is_turned(angle: float) -> None:
    """A sensor whose axes are none of the calibration's has several modes of A and h.

    Steps of a fortieth of the way change a smooth likelihood's slope by 0.3; another mode is tens
    to hundreds away.
    """
    C = Rotation.from_euler("z", angle, degrees=True).as_matrix() @ np.diag([1.3, 0.8, 1.0])
    whole = read(SensorNoise(1.5, 0.1, 3.0), C, 1)
    few = LearntReadings(whole.x[:120], whole.R[:120], whole.field[:120], whole.path_m[:120])
    likelihood = SpectrumLikelihood(few, 0.3, 10.0, WAVES)
    first, last = np.array([[0.0, -0.45, -1.5, -5.0, 2.0], [-2.0, -0.9, -4.0, -5.0, 2.5]])
    along = [likelihood.log_likelihood(first + s * (last - first)) for s in np.linspace(0, 1, 41)]
    assert np.abs(np.diff(along, 2)).max() < 1.0


def test_a_search_ends_at_a_maximum() -> None:
    """Another method finds less than half a nat more from there."""
    readings = read(SensorNoise(1.5, 0.1, 3.0), np.diag([1.3, 0.8, 1.0]), 0)
    found = learnt_spectrum(readings, 0.3, 10.0, WAVES)
    likelihood = SpectrumLikelihood(readings, 0.3, 10.0, WAVES)

    def cost(at: FloatArray) -> float:
        return -likelihood.log_likelihood(at)

    more = minimize(
        cost,
        found.at,
        method="Nelder-Mead",
        bounds=Bounds(LOWEST, HIGHEST),
        options={"maxfev": 300, "xatol": 0.01, "fatol": 0.02},
    )
    assert -more.fun < found.log_likelihood + 0.5


def test_of_two_searches_the_likelier_counts() -> None:
    readings = read(SensorNoise(1.5, 0.1, 3.0), np.eye(3), 4)
    found = learnt_spectrum(readings, 0.3, 10.0, WAVES)
    ends = [
        learnt_spectrum(readings, 0.3, 10.0, WAVES, replace(found, at=start)).log_likelihood
        for start in FIRST
    ]
    assert len(ends) == 2
    assert found.log_likelihood == max(ends)


def test_a_second_search_begins_where_the_first_ended() -> None:
    readings = read(SensorNoise(1.0, 0.3, 2.0), np.eye(3), 3)
    first = learnt_spectrum(readings, 0.1, 1.0, WAVES)
    assert (
        learnt_spectrum(readings, 0.1, 1.0, WAVES, first).log_likelihood
        >= first.log_likelihood - 1e-9
    )
