"""Which part of a calibration changed, told by exact and by noisy synthetic readings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.coordinates import COLUMNS, PARAMETERS, changes_of, columns_of
from l2m_gtsam.qa.metrics.mounting import gains, skews_deg
from l2m_gtsam.records.validation import CalibrationPart
from l2m_gtsam.solve.chi_square import noticed_sigmas
from l2m_gtsam.validation.innovation import (
    ChangeLikelihood,
    detectable_change,
    marginalise_calibration,
    parts_changed,
)
from tests.drives.calibrations import SIGMA, rotations

SEEDS = st.integers(0, 10_000)
SIGMAS = np.append(SIGMA, 0.001)


def readings(seed: int, rows: int = 90) -> FloatArray:
    """White derivatives of readings by the sixteen parameters, of useful size."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.normal(size=(rows, PARAMETERS)) / (10 * SIGMAS))


def spread(seed: int) -> FloatArray:
    """A covariance with correlations."""
    mixing = np.eye(PARAMETERS) + 0.2 * np.random.default_rng(seed).normal(size=(PARAMETERS,) * 2)
    return np.asarray(mixing @ mixing.T * np.outer(SIGMAS, SIGMAS))


def told(J: FloatArray, innovation: FloatArray) -> ChangeLikelihood:
    return ChangeLikelihood.of(np.column_stack([J, innovation]))


@given(SEEDS)
def test_the_innovation_is_white_under_its_full_covariance(seed: int) -> None:
    """Against the definition: e^T S^-1 e with S = I + J P J^T."""
    J, P, rng = readings(seed), spread(seed), np.random.default_rng(seed + 1)
    e = rng.normal(size=len(J)) + J @ rng.multivariate_normal(np.zeros(PARAMETERS), P)
    found = marginalise_calibration(told(J, e), P, changes_of(np.eye(3)))
    S = np.eye(len(J)) + J @ P @ J.T
    assert found.squared == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-9)


@given(SEEDS)
def test_a_change_is_estimated_as_least_squares_do(seed: int) -> None:
    """Generalised least squares over one part, written out with the full covariance."""
    J, P, basis = readings(seed), spread(seed), changes_of(np.eye(3))
    e = np.random.default_rng(seed).normal(size=len(J))
    found = marginalise_calibration(told(J, e), P, basis)
    weights = np.linalg.inv(np.eye(len(J)) + J @ P @ J.T)
    for part in CalibrationPart:
        A = J @ basis[:, COLUMNS[part]]
        information = A.T @ weights @ A
        expected = np.linalg.solve(information, A.T @ weights @ e)
        value, covariance = found.estimate(columns_of([part]))
        np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=1e-7, atol=1e-14)
        gain = expected @ information @ expected
        assert found.explained(columns_of([part])) == pytest.approx(gain, rel=1e-7)
        worst = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
        sigmas = noticed_sigmas(len(value), 1e-3 / len(COLUMNS), 0.01)
        assert detectable_change(found, part, 1e-3) == pytest.approx(sigmas * worst, rel=1e-7)


@given(SEEDS)
def test_readings_told_elsewhere_tell_the_same(seed: int) -> None:
    """Innovations of a linear model about another place, counted back: nothing is different."""
    J, rng = readings(seed), np.random.default_rng(seed)
    e, away = rng.normal(size=len(J)), rng.normal(size=PARAMETERS) * SIGMAS
    here, there = told(J, e), told(J, e - J @ away)
    assert there.recentred(away).squared == pytest.approx(here.squared, rel=1e-9)
    np.testing.assert_allclose(
        there.recentred(away).estimate(range(16))[0],
        here.estimate(range(16))[0],
        rtol=1e-6,
        atol=1e-9,
    )


@given(rotations(), SEEDS)
def test_coordinates_are_what_they_are_called(R: FloatArray, seed: int) -> None:
    """Small changes of a rotated orthogonal sensor, in its own terms, to second order."""
    tiny = 1e-4
    amounts = tiny * np.random.default_rng(seed).uniform(-1, 1, 9)
    basis = changes_of(R)[3:12, 3:12]
    C = R + (basis @ amounts).reshape(3, 3)
    np.testing.assert_allclose(gains(C) - 1, amounts[3:6], atol=10 * tiny**2)
    # an arcsine near zero is exact to rounding of cosines
    np.testing.assert_allclose(skews_deg(C), amounts[6:9], atol=100 * tiny**2)
    U, _, Vt = np.linalg.svd(C @ R.T)
    R_mag_lidar = U @ Vt @ R
    turn = Rotation.from_matrix(R @ R_mag_lidar.T).as_rotvec(degrees=True)  # R_lidar_mag's
    np.testing.assert_allclose(turn, amounts[:3], atol=100 * tiny**2)


AMOUNTS = {
    CalibrationPart.PLACE: [0.04, 0.0, -0.02],
    CalibrationPart.ROTATION: [0.0, 3.0, 1.0],
    CalibrationPart.GAINS: [0.0, 0.05, 0.0],
    CalibrationPart.ANGLES: [3.0, 0.0, 0.0],
    CalibrationPart.OFFSET: [3.0, 0.0, 0.0],
    CalibrationPart.CLOCK: [0.03],
}


@pytest.mark.parametrize("part", list(CalibrationPart))
def test_the_part_that_changed_is_named(part: CalibrationPart) -> None:
    """And no other, with the amount by which it changed, in readings without noise."""
    J, basis = readings(3), changes_of(np.eye(3))
    change = np.zeros(PARAMETERS)
    change[COLUMNS[part]] = AMOUNTS[part]
    found = marginalise_calibration(told(J, J @ basis @ change), spread(3), basis)
    assert parts_changed(found, len(J), 1e-3) == (part,)
    value, _ = found.estimate(columns_of([part]))
    np.testing.assert_allclose(value, AMOUNTS[part], rtol=1e-6, atol=1e-9)


def test_two_parts_that_changed_are_both_named() -> None:
    J, basis = readings(4), changes_of(np.eye(3))
    change = np.zeros(PARAMETERS)
    for part in (CalibrationPart.PLACE, CalibrationPart.ROTATION):
        change[COLUMNS[part]] = AMOUNTS[part]
    found = marginalise_calibration(told(J, J @ basis @ change), spread(4), basis)
    assert set(parts_changed(found, len(J), 1e-3)) == {
        CalibrationPart.PLACE,
        CalibrationPart.ROTATION,
    }


def test_nothing_is_named_by_chance() -> None:
    """Of 400 unchanged sensors hardly one is said to have changed, and all statistics are true."""
    P, basis = spread(5), changes_of(np.eye(3))
    root = np.linalg.cholesky(P)
    named, parameters, whole = 0, [], []
    for seed in range(400):
        rng, J = np.random.default_rng([seed, 1]), readings(seed, 60)
        e = J @ root @ rng.normal(size=PARAMETERS) + rng.normal(size=len(J))
        found = marginalise_calibration(told(J, e), P, basis)
        named += bool(parts_changed(found, len(J), 1e-2))
        parameters.append(found.explained(range(16)))
        whole.append(found.squared)
    # Four expected; more than twelve has a chance of one in a thousand.
    assert named <= 12
    # Means of 400 chi-squares, five standard errors wide.
    for values, freedom in ((parameters, PARAMETERS), (whole, 60)):
        assert np.mean(values) == pytest.approx(freedom, abs=5 * np.sqrt(2 * freedom / 400))
        inside = np.mean(np.array(values) < chi2.ppf(0.95, freedom))
        assert inside == pytest.approx(0.95, abs=0.05)


@pytest.mark.parametrize("part", [CalibrationPart.PLACE, CalibrationPart.CLOCK])
def test_a_detectable_change_is_missed_once_in_a_hundred_times(part: CalibrationPart) -> None:
    """In the direction that shows least; 2000 drives miss 20, and five standard errors more."""
    J, basis, P = readings(4), changes_of(np.eye(3)), spread(4)
    known = marginalise_calibration(told(J, np.zeros(len(J))), P, basis)
    *_, axes = np.linalg.svd(known.root[:, COLUMNS[part]])
    change = np.zeros(PARAMETERS)
    change[COLUMNS[part]] = detectable_change(known, part, 1e-3) * axes[-1]
    rng, missed = np.random.default_rng(7), 0
    for _ in range(2000):
        # what a drive shows of a change: root times it, and white noise
        seen = known.root @ change + rng.normal(size=PARAMETERS)
        missed += not parts_changed(ChangeLikelihood(known.root, seen, 0.0), len(J), 1e-3)
    assert missed == pytest.approx(20, abs=5 * np.sqrt(20))


def test_what_readings_do_not_depend_on_is_not_named() -> None:
    """A vehicle whose motion is not known tells nothing of a clock."""
    J, basis = readings(6), changes_of(np.eye(3))
    J[:, 15] = 0.0
    e = J[:, 12] * 5.0
    found = marginalise_calibration(told(J, e), spread(6), basis)
    assert CalibrationPart.CLOCK not in parts_changed(found, len(J), 1e-3)
    assert detectable_change(found, CalibrationPart.CLOCK, 1e-3) == np.inf
