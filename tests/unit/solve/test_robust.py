"""Readings that nothing explains: weights, noise that withstands them, stretches, their names."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.records.calibration import Return
from l2m_gtsam.solve.noise import NOISE_RANGE
from l2m_gtsam.solve.robust import (
    WEIGHTS,
    JudgedReadings,
    Loss,
    RobustOptions,
    consistent,
    disagreements,
    grown,
    median_noise,
    truncated_weights,
)

LARGEST = RobustOptions().largest


def test_noise_passes_as_often_as_promised() -> None:
    r2 = chi2.rvs(3, size=200_000, random_state=np.random.default_rng(0))
    # 20 of 200,000 are expected; a Poisson number lies below 40 but for one time in 10,000.
    assert 4 < np.sum(r2 > LARGEST) < 40


@given(r2=st.floats(0, 1e6), mu=st.floats(0.01, 1e4))
def test_graduated_weights_are_those_of_the_paper(r2: float, mu: float) -> None:
    weight = truncated_weights(np.array([r2]), LARGEST, mu)[0]
    low, high = mu / (mu + 1) * LARGEST, (mu + 1) / mu * LARGEST
    if r2 <= low * (1 - 1e-9):
        assert weight == 1
    elif r2 >= high * (1 + 1e-9):
        assert weight == 0
    else:
        expected = np.sqrt(LARGEST * mu * (mu + 1) / r2) - mu
        # The difference of two numbers of the size of mu.
        assert weight == pytest.approx(np.clip(expected, 0, 1), abs=1e-9 * (1 + mu))


@pytest.mark.parametrize("loss", list(Loss))
def test_no_weight_grows_with_the_residual(loss: Loss) -> None:
    r2 = np.linspace(0, 20 * LARGEST, 400)
    for mu in (1.0, 10.0, np.inf):
        weights = WEIGHTS[loss](r2, LARGEST, mu)
        assert ((weights >= 0) & (weights <= 1)).all()
        assert (np.diff(weights) <= 1e-12).all()
        assert weights[0] == 1


def huber(r2: FloatArray) -> FloatArray:
    return np.where(r2 <= LARGEST, r2, 2 * np.sqrt(LARGEST * r2) - LARGEST)


def cauchy(r2: FloatArray) -> FloatArray:
    return np.asarray(LARGEST * np.log1p(r2 / LARGEST))


@pytest.mark.parametrize(("loss", "cost"), [(Loss.HUBER, huber), (Loss.CAUCHY, cauchy)])
def test_weights_are_the_slope_of_the_loss(
    loss: Loss, cost: Callable[[FloatArray], FloatArray]
) -> None:
    r2 = np.array([0.01, 0.1, 0.9, 1.2, 30]) * LARGEST
    step = 1e-5 * r2
    slope = (cost(r2 + step) - cost(r2 - step)) / (2 * step)
    np.testing.assert_allclose(WEIGHTS[loss](r2, LARGEST, 1.0), slope, rtol=1e-7)


def test_noise_withstands_a_third_of_wrong_readings() -> None:
    rng = np.random.default_rng(1)
    variance = rng.uniform(0, 0.05, 6000)
    e = np.sqrt(0.2**2 + variance)[:, None] * rng.standard_normal((6000, 3))
    assert median_noise(e, variance) == pytest.approx(0.2, rel=0.03)
    e[::3] += 50.0
    # A third of wrong ones makes the median of all the 75th percentile of the good ones.
    assert 0.2 < median_noise(e, variance) < 0.35


@given(seed=st.integers(0, 2**32 - 1), half=st.integers(0, 40))
def test_half_of_the_readings_are_within_the_median_of_noise(seed: int, half: int) -> None:
    """With an odd number of them one is at the median itself, whatever the map does not know."""
    rng = np.random.default_rng(seed)
    variance = rng.uniform(0.0, 0.5, 2 * half + 1)
    e = rng.normal(0, 3.0, (2 * half + 1, 3)) + 2.0  # beyond what the map's variance explains
    noise = median_noise(e, variance)
    r2 = np.einsum("ni,ni->n", e, e) / (noise**2 + variance)
    if noise > NOISE_RANGE[0]:
        # Rounding of a square and its root.
        assert np.median(r2) == pytest.approx(chi2.ppf(0.5, 3), rel=1e-9)
    else:
        assert np.median(r2) <= chi2.ppf(0.5, 3)


@given(seed=st.integers(0, 1000), share=st.floats(0.0, 0.3), size=st.floats(3.0, 100.0))
def test_one_distortion_tells_wrong_readings(seed: int, share: float, size: float) -> None:
    rng = np.random.default_rng(seed)
    b = rng.normal([20.0, 0.0, -40.0], 10, (300, 3))
    C, H = np.eye(3) + rng.normal(0, 0.1, (3, 3)), rng.normal(0, 20, 3)
    z = b @ C.T + H + 0.1 * rng.standard_normal(b.shape)
    wrong = rng.random(300) < share
    direction = rng.standard_normal((int(wrong.sum()), 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    z[wrong] += size * direction
    keep = consistent(b, z, np.zeros(300), LARGEST)
    # At 30 sigma each wrong one is told; of the good ones one in 10,000 may be lost, and a few
    # more where the median over few readings is low.
    assert not keep[wrong].any()
    assert (~keep[~wrong]).sum() <= 3


def test_a_stretch_grows_to_where_the_field_is_right() -> None:
    rng = np.random.default_rng(3)
    n = np.arange(400)
    bump = 3.0 * np.exp(-0.5 * ((n - 200) / 20) ** 2)
    e = 0.2 * rng.standard_normal((400, 3))
    e[:, 1] += bump
    rejected = np.einsum("ni,ni->n", e, e) > LARGEST * 0.2**2
    stretch = grown(rejected, e, 0.2, np.zeros(400))
    assert (stretch >= rejected).all()
    # Twice the noise is told by a mean of nine, half of it is not.
    assert stretch[bump > 0.4].all()
    assert not stretch[bump < 0.02].any()


def test_stray_readings_do_not_grow() -> None:
    rng = np.random.default_rng(4)
    e = 0.2 * rng.standard_normal((2000, 3))
    stray = np.zeros(2000, dtype=np.bool_)
    stray[::10] = True
    e[stray] += 30.0
    np.testing.assert_array_equal(grown(stray, e, 0.2, np.zeros(2000)), stray)


def test_what_the_map_does_not_know_is_no_stretch() -> None:
    """An error over a quarter of the readings that the map's variance covers, or does not."""
    e = np.zeros((400, 3))
    e[100:200] = 0.8
    seeds = np.zeros(400, dtype=np.bool_)
    seeds[140:145] = True
    assert grown(seeds, e, 0.2, np.zeros(400)).sum() > 90
    assert grown(seeds, e, 0.2, np.full(400, 0.8**2)).sum() == 5


def test_a_map_that_errs_everywhere_makes_no_stretch() -> None:
    """A smooth error all along the drive, larger than noise and map admit to."""
    n = np.arange(2000)
    e = np.column_stack([np.sin(n / 30), np.cos(n / 41), np.sin(n / 53 + 1)])
    seeds = np.zeros(2000, dtype=np.bool_)
    seeds[1000:1005] = True
    assert grown(seeds, e, 0.2, np.zeros(2000)).sum() == 5


def there_and_back(count: int = 100) -> Readings:
    """Return readings of two sensors along 10 m and back, 10 readings a second."""
    way = np.concatenate([np.linspace(0, 10, count), np.linspace(10, 0, count)])
    p = np.column_stack([way, np.zeros_like(way), np.zeros_like(way)])
    stamps = np.arange(2 * count) * 100_000_000
    both = np.tile(np.arange(2 * count), 2)
    return Readings(
        ("left", "right"),
        np.repeat([0, 1], 2 * count),
        stamps[both],
        np.broadcast_to(np.eye(3), (4 * count, 3, 3)),
        p[both],
        np.zeros((4 * count, 3)),
    )


def judged(rejected: IntArray) -> JudgedReadings:
    readings = there_and_back()
    residual = np.zeros((len(readings), 3))
    residual[rejected, 2] = 7.0
    wrong = np.zeros(len(readings), dtype=np.bool_)
    wrong[rejected] = True
    return JudgedReadings(readings, readings.p_map_lidar, residual, wrong)


def test_what_passes_by_is_told_from_what_has_changed() -> None:
    there = np.arange(30, 51)
    (passing,) = disagreements(judged(np.concatenate([there, 200 + there + 1])))
    assert passing.sensors == ("left", "right")
    assert passing.readings == 42
    assert (passing.start_ns, passing.end_ns) == (3_000_000_000, 5_100_000_000)
    assert passing.size == 7.0
    assert passing.passed_again is Return.AS_MAPPED
    np.testing.assert_allclose(passing.p_from, [30 / 9.9, 0, 0])
    assert passing.length == pytest.approx(21 / 9.9)

    back = 199 - there
    first, second = disagreements(judged(np.concatenate([there, back[::-1]])))
    assert first.end_ns < second.start_ns
    assert first.sensors == second.sensors == ("left",)
    assert first.passed_again is second.passed_again is Return.DIFFERS


def test_a_place_passed_once_and_stray_readings() -> None:
    (end,) = disagreements(judged(np.arange(95, 105)))
    assert end.passed_again is Return.NEVER
    assert disagreements(judged(np.array([5, 6, 40, 80]))) == ()
    assert disagreements(judged(np.array([], dtype=int))) == ()
