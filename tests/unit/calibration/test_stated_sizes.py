"""What was stated wrongly shows; what was stated rightly does not."""

import numpy as np
import pytest

from l2m_gtsam.calibration.stated_sizes import (
    NoiseBesidePoses,
    poses_too_small,
    shown_by_one,
    size_beside_noise,
    size_of_noise,
    without_prior,
)
from l2m_gtsam.records.error_budget import LEAST_GAIN, ErrorCause, StatedSize
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


@pytest.mark.parametrize(("others", "whose"), [(0.8, "mag"), (1.2, "mag"), (2.0, None)])
def test_errors_of_poses_are_of_one_sensor_if_the_others_do_not_show_them(
    others: float, whose: str | None
) -> None:
    noise = StatedSize(ErrorCause.NOISE, 1.0, 0.0, "other")
    stated = (noise, StatedSize(ErrorCause.POSES, 2.4, 100.0))
    assert poses_too_small(stated)
    assert not poses_too_small(stated[:1])
    without = (StatedSize(ErrorCause.POSES, others, 0.0),)
    found = shown_by_one(stated, without, "mag")
    assert found[0] is noise
    assert found[1].sensor == whose
    assert shown_by_one(stated, (), "mag") == stated  # nothing is known without it
