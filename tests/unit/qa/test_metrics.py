"""Figures of a calibration against closed forms and plain loops."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.qa.metrics.assemble import sphere
from l2m_gtsam.qa.metrics.evidence import cross
from l2m_gtsam.qa.metrics.fit import correlation, lasting
from l2m_gtsam.qa.metrics.mounting import axis_order, gains, skews_deg
from l2m_gtsam.qa.metrics.plain import evenly
from l2m_gtsam.qa.metrics.repeatability import PartialEstimate, compare_halves, no_halves
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.repeatability import furthest, furthest_shown, halves_agree
from l2m_gtsam.records.repeatability import Halves
from l2m_gtsam.storage.record_files import read_metrics

SEEDS = st.integers(0, 10_000)


@given(SEEDS)
def test_gains_and_skews_do_not_depend_on_the_mounting(seed: int) -> None:
    """C = K R with the sensor's own K: turned otherwise it has the same gains and angles."""
    rng = np.random.default_rng(seed)
    K = np.eye(3) + rng.normal(0, 0.1, (3, 3))
    R = Rotation.random(random_state=seed).as_matrix()
    np.testing.assert_allclose(gains(K @ R), gains(K), rtol=1e-12)
    np.testing.assert_allclose(skews_deg(K @ R), skews_deg(K), atol=1e-9)


def test_a_skew_is_the_angle_that_was_put_in() -> None:
    lean = np.deg2rad(3.0)
    C = np.array([[1.0, 0, 0], [2 * np.sin(lean), 2 * np.cos(lean), 0], [0, 0, 1.0]])
    np.testing.assert_allclose(skews_deg(C), [3.0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(gains(C), [1, 2, 1])


@given(SEEDS)
def test_any_order_of_axes_is_found_again(seed: int) -> None:
    """Rows in any order with any signs, turned by up to 20 degrees."""
    rng = np.random.default_rng(seed)
    order = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)[:, None]
    turn = Rotation.from_rotvec(np.deg2rad(20) * rng.uniform(-1, 1, 3) / 3**0.5).as_matrix()
    found = axis_order(order @ turn)
    names = [f"{'+' if row.sum() > 0 else '-'}{'xyz'[np.abs(row).argmax()]}" for row in order]
    assert found.along == tuple(names)
    assert found.mirrored == (np.linalg.det(order) < 0)
    assert found.off_deg <= 20 + 1e-9


@given(SEEDS, st.integers(5, 60))
def test_the_correlation_is_that_of_plain_loops(seed: int, count: int) -> None:
    series = np.random.default_rng(seed).normal(size=(count, 3))
    centred = series - series.mean(axis=0)
    lags = count // 3
    slow = [np.sum(centred[: count - k] * centred[k:]) for k in range(lags + 1)]
    # The fast transform loses a few digits of 16.
    np.testing.assert_allclose(correlation(series, lags), np.array(slow) / slow[0], atol=1e-10)


def test_a_lasting_error_is_worth_fewer_readings() -> None:
    """Of an autoregressive series with correlation rho, (1 + rho) / (1 - rho) count as one."""
    rng, rho = np.random.default_rng(3), 0.8
    e = rng.normal(size=40_000)
    for k in range(1, len(e)):
        e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * e[k]
    found = lasting(correlation(e[:, None], 60))
    # 40,000 readings are worth 4,400: the sum of 60 correlations is known to about a tenth.
    assert found == pytest.approx((1 + rho) / (1 - rho), rel=0.15)


def test_a_constant_series_has_no_correlation() -> None:
    np.testing.assert_array_equal(correlation(np.ones((10, 2)), 3), [1, 0, 0, 0])


@given(SEEDS)
def test_cross_products(seed: int) -> None:
    a, b = np.random.default_rng(seed).normal(size=(2, 4, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", cross(a), b), np.cross(a, b), atol=1e-12)


def test_directions_are_spread_evenly() -> None:
    """Any cap of space holds its share of them: here of 30 degrees about random axes."""
    points = sphere(400)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)
    share = (1 - np.cos(np.deg2rad(30))) / 2
    axes = Rotation.random(50, random_state=1).apply([0.0, 0.0, 1.0])
    held = np.mean(points @ axes.T > np.cos(np.deg2rad(30)), axis=0)
    # 27 points of 400; those at the edge of a cap come and go.
    np.testing.assert_allclose(held, share, atol=5 / 400)


@given(st.integers(1, 500), st.integers(2, 60))
def test_thinning_keeps_both_ends(count: int, most: int) -> None:
    kept = evenly(count, most)
    assert len(kept) == min(count, most)
    assert (kept[0], kept[-1]) == (0, count - 1)
    assert (np.diff(kept) > 0).all()


def half(seed: int, covariance: np.ndarray) -> PartialEstimate:
    rng = np.random.default_rng(seed)
    true = np.concatenate([[0.1, 0.2, 0.3], np.eye(3).ravel(), [1.0, 2.0, 3.0]])
    return PartialEstimate(rng.multivariate_normal(true, covariance), covariance)


def covariance(seed: int) -> np.ndarray:
    """Of parameters in units as different as metres and microtesla."""
    root = np.random.default_rng(seed).normal(size=(15, 40))
    scale = np.repeat([1e-3, 1e-3, 1e-1], [3, 9, 3])
    return np.asarray(root @ root.T / 40 * np.outer(scale, scale))


def test_honest_halves_are_one_sigma_apart() -> None:
    """The mean square of the distance over 400 pairs is 1: its spread is sqrt(2 / 15 / 400)."""
    squares = []
    for seed in range(400):
        S = covariance(seed)
        found = compare_halves(half(2 * seed + 1, S), half(2 * seed + 2, S))
        assert found.determined == 15
        squares.append(found.distance**2)
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / 15 / 400))


def test_what_a_half_leaves_open_takes_no_part() -> None:
    S = covariance(1)
    open_ = S.copy()
    open_[2, :] = open_[:, 2] = 0.0
    open_[2, 2] = np.inf
    found = compare_halves(half(1, S), PartialEstimate(half(2, S).vector, open_))
    assert found.determined == 14
    assert np.isinf(found.sigma[2])
    assert np.isfinite(found.distance)


def test_halves_of_nothing_say_why() -> None:
    nothing = PartialEstimate(np.zeros(15), np.diag(np.full(15, np.inf)))
    assert "determine nothing" in compare_halves(nothing, nothing).reason


def test_halves_that_differ_by_what_nobody_minds_agree() -> None:
    """Ten sigmas, but half a millimetre."""
    vector = np.concatenate([[0.0, 0, 0], np.eye(3).ravel(), [0.0, 0, 0]])
    S = np.diag(np.repeat([5e-5, 1e-4, 1e-2], [3, 9, 3]) ** 2)
    near, far = vector.copy(), vector.copy()
    near[:3] += 5e-4
    far[:3] += 5e-2
    options = QaOptions()
    assert halves_agree(
        compare_halves(PartialEstimate(vector, S), PartialEstimate(near, S)), options
    )
    assert not halves_agree(
        compare_halves(PartialEstimate(vector, S), PartialEstimate(far, S)), options
    )
    assert halves_agree(no_halves("not looked at"), options)


@pytest.mark.parametrize(("name", "at", "by"), [("t", 1, 0.05), ("C", 4, 0.02), ("H", 14, 1.5)])
def test_t_c_and_h_are_judged_apart(name: str, at: int, by: float) -> None:
    """What differs in one of them by ten sigmas is within chance for all fifteen together."""
    vector = np.concatenate([[0.0, 0, 0], np.eye(3).ravel(), [0.0, 0, 0]])
    sigma, options = np.ones(15), QaOptions(halves_chance=1e-6)
    sigma[at] = by / 10
    sigma[[k for k in range(15) if k != at]] = 1e-3
    other = vector.copy()
    other[at] += by
    S = np.diag(sigma**2) / 2  # of each half
    found = compare_halves(PartialEstimate(vector, S), PartialEstimate(other, S))
    groups = {each.name: each for each in found.distances}
    assert {each: groups[each].freedom for each in groups} == {"t": 3, "C": 9, "H": 3}
    for each, distance in groups.items():
        assert distance.chi_square == pytest.approx(100 * (each == name), abs=1e-9)
    limit = chi2.ppf(1 - 1e-6 / 3, groups[name].freedom)
    assert furthest(found, options) == pytest.approx(np.sqrt(100 / limit))
    assert not halves_agree(found, options)


def halves_apart(t_m: float, H_ut: float) -> Halves:
    """Return halves that differ by so much in t and H, and by nothing in C, sigmas all alike."""
    vector = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
    other = vector.copy()
    other[[0, 12]] += t_m, H_ut
    S = np.diag(np.repeat([1e-4, 1e-4, 1e-2], [3, 9, 3]) ** 2) / 2  # of each half
    return compare_halves(PartialEstimate(vector, S), PartialEstimate(other, S))


@pytest.mark.parametrize(
    ("t_m", "H_ut", "limited", "passes"),
    [
        (2e-4, 0.0, 2.0, ""),  # within chance: nothing to tolerate
        (2e-3, 0.0, 20.0, "t under 3 mm, passes"),
        (2e-3, 0.2, 20.0, "t under 3 mm, H under 0.3 µT, passes"),
        (2e-3, 0.5, 50.0, ""),  # H is not negligible: it decides, and nothing passes
    ],
)
def test_a_difference_below_the_tolerance_is_shown_as_it_is(
    t_m: float, H_ut: float, limited: float, passes: str
) -> None:
    options = QaOptions()
    limit = chi2.ppf(1 - options.halves_chance / 3, 3)
    ratio, phrase = furthest_shown(halves_apart(t_m, H_ut), options)
    assert ratio == pytest.approx(limited / np.sqrt(limit))
    assert phrase == passes


def test_halves_that_are_not_asked_for_are_not_judged() -> None:
    found, off = halves_apart(0.05, 5.0), QaOptions(halves=False)
    assert not halves_agree(found, QaOptions())
    assert halves_agree(found, off)
    assert np.isnan(furthest_shown(found, off)[0])


def test_halves_of_an_older_file_are_judged_together() -> None:
    """Distances of t, C and H apart are not in it."""
    nothing = (0.1,) * 15
    for distance, agree in ((1.5, True), (2.0, False)):  # 34 and 60 of 15: 38 is the limit
        found = Halves(nothing, nothing, distance, 15, 5.0)
        assert halves_agree(found, QaOptions()) is agree


def test_a_turn_between_halves_is_its_angle() -> None:
    S, turn = covariance(1), Rotation.from_rotvec([0.0, 0.0, np.deg2rad(7)]).as_matrix()
    one, two = (
        np.concatenate([np.zeros(3), C.ravel(), np.zeros(3)]) for C in (1.1 * np.eye(3), turn)
    )
    found: Halves = compare_halves(PartialEstimate(one, S), PartialEstimate(two, S))
    assert found.turned_deg == pytest.approx(7)


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (None, "no such file; `l2m calibrate` writes it"),
        ("", "not a metrics file of this program"),
        ('{"format": "l2m-metrics", "version": 2}', "not a metrics file.*version"),
        ("[1]", "not a metrics file"),
    ],
)
def test_a_damaged_metrics_file_is_one_line(
    tmp_path: Path, content: str | None, pattern: str
) -> None:
    path = tmp_path / "metrics.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(CalibrationError, match=pattern) as error:
        read_metrics(path)
    assert "\n" not in str(error.value)
