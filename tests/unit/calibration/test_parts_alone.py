"""What the scatter of parts of a drive says of a fit that takes its share of errors that last."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from l2m_gtsam.calibration.cluster_robust import VarianceRatio
from l2m_gtsam.calibration.half_difference import WhiteGroup
from l2m_gtsam.calibration.joint_information import Rows
from l2m_gtsam.calibration.parts_alone import MODES, ByParts, Walk, by_parts, lasting, share_shown
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.data import FloatArray, Readings

READINGS, NOISE, WALK = 240, 0.2, 0.4
OWN = np.arange(SENSOR)
FIELD = np.array([30.0, 20.0, 40.0])


def readings_of(count: int) -> Readings:
    at = np.linspace(0, 2 * np.pi, count)
    p = np.column_stack([3 * np.sin(2 * at), 2 * np.sin(3 * at + 1), np.zeros(count)])
    return Readings(
        sensors=("mag",),
        sensor=np.zeros(count, dtype=np.int64),
        stamp_ns=np.arange(count) * 10**8,
        R_map_lidar=np.broadcast_to(np.eye(3), (count, 3, 3)),
        p_map_lidar=p,
        field=np.zeros((count, 3)),
    )


def jacobian(rng: np.random.Generator) -> FloatArray:
    """Derivatives of a drive whose field turns slowly, white, shape (3 N, 16)."""
    u = np.linspace(0, 1, READINGS)[:, None]
    waves = rng.permutation(np.arange(1, 6))[:3]
    b = FIELD * np.sin(2 * np.pi * waves * u + rng.uniform(0, 2 * np.pi, (1, 3)))
    of_C = np.zeros((READINGS, 3, 9))
    for axis in range(3):
        of_C[:, axis, 3 * axis : 3 * axis + 3] = b
    of_H = np.broadcast_to(np.eye(3), (READINGS, 3, 3))
    others = 20 * rng.standard_normal((READINGS, 3, 4))
    parts = [others[..., :3], of_C, of_H, others[..., 3:]]
    return np.asarray(np.concatenate(parts, axis=2).reshape(-1, SENSOR) / NOISE)


def fit(X: FloatArray, wrong: FloatArray) -> tuple[FloatArray, ByParts]:
    """Fit to errors in uT, (N, 3); return the errors of all parameters and what is said of them."""
    covariance: FloatArray = np.asarray(np.linalg.inv(X.T @ X), dtype=np.float64)
    white = wrong.ravel() / NOISE
    x = covariance @ (X.T @ white)
    rows = Rows(0, OWN, X, X @ x - white, np.arange(READINGS))
    group = WhiteGroup(rows, np.broadcast_to(np.eye(3) / NOISE, (READINGS, 3, 3)))
    return x, by_parts(0, x[:15], readings_of(READINGS), [group], OWN, covariance)


def walk(rng: np.random.Generator) -> FloatArray:
    return np.asarray(WALK / np.sqrt(READINGS) * np.cumsum(rng.standard_normal((READINGS, 3)), 0))


def test_variances_are_those_of_an_offset_that_walks() -> None:
    """In the mean over drives, where the scatter itself shows half of it or a third."""
    rng = np.random.default_rng(1)
    found: dict[str, list[tuple[float, float]]] = {"C": [], "H": []}
    for _ in range(150):
        wrong = walk(rng)
        x, alone = fit(jacobian(rng), wrong + NOISE * rng.standard_normal(wrong.shape))
        moment = wrong[rng.integers(READINGS)]
        for name, e in (("C", x[3:12]), ("H", x[12:15] - moment)):
            at = slice(3, 12) if name == "C" else slice(12, 15)
            P = alone.covariance[at, at]
            distance = float(e @ np.linalg.solve(P, e)) / len(e)
            found[name].append((distance, alone.ratios[name][1].value))
    for name, each in found.items():
        true, said = np.mean(each, axis=0)
        # Walks are mostly one wave: a mean of some 150 x 3 squares of heavy tails.
        assert said == pytest.approx(true, rel=0.3), name
        assert true > 5, name


def test_white_noise_is_left_as_it_is() -> None:
    rng = np.random.default_rng(2)
    ratios = [
        ratio.value
        for _ in range(60)
        for ratio in fit(jacobian(rng), NOISE * rng.standard_normal((READINGS, 3)))[1].ratios["C"]
    ]
    # One of twenty scatters by more than chance, and counts for up to thrice its excess.
    assert np.mean(ratios) == pytest.approx(1, abs=0.1)


def test_the_share_that_parts_show_is_that_of_many_walks() -> None:
    rng = np.random.default_rng(3)
    X = jacobian(rng)
    covariance: FloatArray = np.asarray(np.linalg.inv(X.T @ X), dtype=np.float64)
    rows = Rows(0, OWN, X, np.zeros(len(X)), np.arange(READINGS))
    group = WhiteGroup(rows, np.broadcast_to(np.eye(3) / NOISE, (READINGS, 3, 3)))
    modes = Walk.of(readings_of(READINGS), [group], OWN[12:15], covariance)
    drawn = rng.standard_normal((4000, 3 * MODES)) @ modes.rows[0].T * NOISE
    steps = drawn.reshape(4000, READINGS, 3)
    # It is a walk: its variance is that of Brownian motion about its mean, but for fast modes.
    spread = np.square(steps - steps.mean(axis=1, keepdims=True)).mean()
    assert spread == pytest.approx(modes.spread, rel=0.05)
    assert modes.spread == pytest.approx(1 / 6, rel=0.06)
    moved = np.cov((drawn / NOISE @ X @ covariance).T)  # how the fit follows each
    sigma = np.sqrt(np.diag(moved))
    expected = modes.followed @ modes.followed.T
    # Five standard deviations of a covariance of 4,000 draws.
    np.testing.assert_array_less(np.abs(moved - expected) / np.outer(sigma, sigma), 0.11)


def test_shares_are_those_of_the_parameters_in_any_axes() -> None:
    rng = np.random.default_rng(4)
    seen, followed = rng.standard_normal((8, 3, 5)), rng.standard_normal((3, 5))
    root = rng.standard_normal((3, 3)) + 3 * np.eye(3)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    P = root @ root.T
    one = share_shown(P, seen, followed, 0.5)
    turned = share_shown(turn @ P @ turn.T, turn @ seen, turn @ followed, 0.5)
    assert turned == pytest.approx(one, rel=1e-9)
    assert share_shown(P, seen, followed, 0.0) > one > 0


def test_only_what_is_no_chance_lasts() -> None:
    by_chance = VarianceRatio(1.2, 20.0, 7, 3.0, 0.8)
    assert lasting(by_chance, 0.4).value == 1.2
    found = lasting(VarianceRatio(4.0, 20.0, 7, 3.0, 0.8), 0.4)
    assert (found.value, found.directions, found.freedom) == (1 + 3 * 0.8 / 0.4, 3.0, 21.0)


def test_readings_that_are_whitened_together_follow_as_each_by_itself() -> None:
    rng = np.random.default_rng(5)
    raw, values = rng.standard_normal((12, 6)), rng.standard_normal((4, 2))
    alone = np.stack([np.tril(rng.standard_normal((3, 3))) + 3 * np.eye(3) for _ in range(4)])
    together = block_diag(*alone)
    columns, own = np.arange(6), np.array([4, 1])
    rows = Rows(0, columns, together @ raw, np.zeros(12), np.arange(4))
    expected = np.concatenate([np.repeat(v, 3)[:, None] * raw[:, own] for v in values.T], axis=1)
    for whitening in (alone, together):
        found = WhiteGroup(rows, whitening).following(values, own)
        np.testing.assert_allclose(found, together @ expected, atol=1e-12)
