"""What was stated wrongly shows; what was stated rightly does not."""

import numpy as np
import pytest

from l2m_gtsam.calibration.stated_sizes import (
    NoiseBesidePoses,
    size_beside_noise,
    size_of_noise,
    without_prior,
)
from l2m_gtsam.records.error_budget import LEAST_GAIN
from l2m_gtsam.solve.linear_algebra import inverse


def test_readings_without_the_prior_are_those_alone() -> None:
    rng = np.random.default_rng(0)
    Z, half = rng.standard_normal((40, 6)), rng.standard_normal((6, 9))
    prior = half @ half.T
    y = rng.standard_normal(40)
    covariance = inverse(Z.T @ Z + prior)
    found = without_prior(covariance, prior, covariance @ Z.T @ y)
    # v = L^T w: what the readings say of v is Z L^-T.
    white = np.linalg.solve(np.linalg.cholesky(prior), Z.T)
    np.testing.assert_allclose(found.information, white @ white.T, atol=1e-9)
    np.testing.assert_allclose(found.pull, white @ y, atol=1e-9)


@pytest.mark.parametrize("factor", [1 / 3, 3.0])
def test_a_noise_that_is_stated_wrongly(factor: float) -> None:
    found = size_of_noise("mag", 0.2 * factor, 0.2, 900.0)
    assert found.is_wrong
    assert found.ratio == pytest.approx(1 / factor)


def test_rightly_stated_noise_is_seldom_called_wrong() -> None:
    rng = np.random.default_rng(1)
    drawn = np.sqrt(rng.chisquare(900, 4000) / 900)
    gains = [size_of_noise("mag", 0.2, 0.2 * each, 900.0).gain for each in drawn]
    # 4 of 4,000 expected by chance.
    assert sum(gain > LEAST_GAIN for gain in gains) < 12
    # Twice a logarithm of one number's likelihood: its mean is that of chi-square of one.
    assert np.mean(gains) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("times", [2.0, 3.0])
def test_errors_of_poses_that_leave_no_room_for_noise(times: float) -> None:
    """White noise of 0.2 uT beside 0.1 uT that lasts, where poses are stated to leave more."""
    rng = np.random.default_rng(2)
    lasting = 0.1 * np.sin(np.arange(4000)[:, None] / 50 + [0.0, 1.0, 2.0]) * np.sqrt(2)
    residual = lasting + 0.2 * rng.standard_normal((4000, 3))
    of_poses = (times * 0.1) ** 2
    found = size_beside_noise([NoiseBesidePoses(residual, 1e-4, of_poses)])
    assert found is not None
    # What lasts is the difference of two variances, of 2 % each.
    assert found.ratio == pytest.approx(1 / times, rel=0.1)
    assert found.is_wrong
    assert size_beside_noise([NoiseBesidePoses(residual, 0.19, of_poses)]) is None
