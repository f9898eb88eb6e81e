"""The noise of each drive, by what residuals that follow each other differ by."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.drive_noise import FEWEST, SCATTER, noise_ratios
from l2m_gtsam.data import FloatArray


def residuals(sigmas: FloatArray, readings: int, seed: int) -> FloatArray:
    """Return white residuals of drives, one after the other, shape (K readings, 3)."""
    white = np.random.default_rng(seed).standard_normal((len(sigmas), readings, 3))
    return (np.asarray(sigmas)[:, None, None] * white).reshape(-1, 3)


@given(
    st.lists(st.floats(0.02, 5.0), min_size=2, max_size=4).filter(lambda x: max(x) > 3 * min(x)),
    st.integers(0, 10**6),
)
def test_ratios_are_those_of_the_noise(sigmas: list[float], seed: int) -> None:
    """Beside that of all; five sigmas of the estimate, over a thousand examples."""
    n, k = 400, len(sigmas)
    found = noise_ratios(residuals(np.array(sigmas), n, seed), np.repeat(np.arange(k), n), k)
    np.testing.assert_allclose(np.mean(found**2), 1)
    expected = np.array(sigmas) / found
    away = np.log(expected) - np.log(expected).mean()
    assert np.abs(away).max() < 5 * SCATTER / np.sqrt(n) * np.sqrt(2)


def test_scatter_is_that_of_the_estimate() -> None:
    """Over 2,000 seeds: the spread of a standard deviation is known to 1.6 %, and n is finite."""
    n, drive = 200, np.repeat([0, 1], 200)
    ratios = np.array(
        [noise_ratios(residuals(np.array([1.0, 3.0]), n, s), drive, 2) for s in range(2000)]
    )
    spread = np.std(np.log(ratios[:, 1] / ratios[:, 0])) / np.sqrt(2)
    assert abs(spread * np.sqrt(n) / SCATTER - 1) < 0.06


def test_drives_alike_have_one_noise() -> None:
    """Two of them are four sigmas apart in 1 of 16,000 seeds."""
    drive = np.repeat([0, 1], 100)
    for seed in range(300):
        assert (noise_ratios(residuals(np.ones(2), 100, seed), drive, 2) == 1).all()


def test_errors_that_last_are_no_noise() -> None:
    """H that drifts by 20 sigmas in one drive, and a map that is wrong by ten along both."""
    n = 500
    e = residuals(np.ones(2), n, 3)
    e[n:] += np.linspace(0, 20, n)[:, None]
    e += 10 * np.sin(np.linspace(0, 12, 2 * n))[:, None]
    assert (noise_ratios(e, np.repeat([0, 1], n), 2) == 1).all()


def test_spikes_are_no_noise() -> None:
    n = 500
    e = residuals(np.ones(2), n, 4)
    e[n::50] += 100
    assert (noise_ratios(e, np.repeat([0, 1], n), 2) == 1).all()


def test_a_drive_of_few_readings_has_the_noise_of_all() -> None:
    few = FEWEST - 1
    e = np.vstack([residuals(np.array([1.0, 4.0]), 300, 5), residuals(np.array([9.0]), few, 6)])
    ratios = noise_ratios(e, np.repeat([0, 1, 2], [300, 300, few]), 3)
    assert ratios[2] == 1
    np.testing.assert_allclose(ratios[1] / ratios[0], 4, rtol=0.25)  # five sigmas


def test_readings_without_noise_tell_nothing() -> None:
    """A sensor that stands still, or a simulation without noise."""
    assert (noise_ratios(np.zeros((200, 3)), np.repeat([0, 1], 100), 2) == 1).all()
