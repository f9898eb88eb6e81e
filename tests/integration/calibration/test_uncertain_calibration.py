"""The one-key solve over a map that knows its errors, against a dense reference."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import block_diag, eigh

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.priors import Difference, Priors
from l2m_gtsam.calibration.view import observe
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.records.calibration import Uncertainty
from tests.drives.uncertain import (
    CALM,
    GIVEN,
    NOISE,
    OPTIONS,
    SENSORS,
    STARTS,
    WORLD,
    all_features,
    dense_rows,
    own_noise,
    turning_poses,
)
from tests.worlds.exact import DipoleWorld

FULL, INDEPENDENT = (  # the drive's frame is the map's
    OneKeyOptions(uncertainty=kind, sensor_noise_ut=NOISE, warp_m=0)
    for kind in (Uncertainty.FULL, Uncertainty.INDEPENDENT)
)


@pytest.fixture(scope="module")
def full(readings: Readings, field_map: HarmonicMap) -> OneKeySolution:
    return solve_one_key(readings, field_map, STARTS, FULL)


@pytest.fixture(scope="module")
def independent(readings: Readings, field_map: HarmonicMap) -> OneKeySolution:
    return solve_one_key(readings, field_map, STARTS, INDEPENDENT)


@dataclass(frozen=True)
class Dense:
    """A Gauss-Newton solve of all unknowns by QR of all rows.

    Attributes
    ----------
    theta
        (t, C row by row, H) of all sensors, then all beta.
    covariance
        Of all of them.
    """

    theta: FloatArray
    covariance: FloatArray


def dense_solution(readings: Readings, field_map: HarmonicMap, near: Estimate) -> Dense:
    """Solve with the errors and weights of an estimate."""
    x = np.einsum("nij,nj->ni", readings.R_map_lidar, near.t[readings.sensor])
    x += readings.p_map_lidar
    errors = field_map.errors_over(x)
    A = all_features(errors, x)
    CR = near.C()[readings.sensor] @ readings.R_map_lidar.transpose(0, 2, 1)
    whiten = np.linalg.inv(np.linalg.cholesky(own_noise(field_map, x, A, CR)))
    ideal = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
    ridges = [np.sqrt(near.ridge[s]) * np.eye(15)[3:12] for s in range(len(SENSORS))]
    prior = block_diag(*ridges, np.linalg.inv(np.linalg.cholesky(errors.covariance)))
    centre = np.concatenate([*(ideal,) * len(SENSORS), np.zeros(len(errors.covariance))])
    theta = centre.copy()
    theta[: 15 * len(SENSORS)] = np.concatenate([near.vector(s) for s in range(len(SENSORS))])
    for _ in range(8):
        e, J = dense_rows(readings, field_map, theta, A)
        rows = np.concatenate([(whiten @ J).reshape(-1, len(theta)), prior])
        right = np.concatenate(
            [np.einsum("nij,nj->ni", whiten, e).ravel(), prior @ (theta - centre)]
        )
        Q, triangular = np.linalg.qr(rows)
        theta = theta - np.linalg.solve(triangular, Q.T @ right)
    inverse = np.linalg.inv(triangular)
    return Dense(theta, inverse @ inverse.T)


@pytest.fixture(scope="module")
def dense(readings: Readings, field_map: HarmonicMap, independent: OneKeySolution) -> Dense:
    view = observe(readings, field_map, independent.estimate, FULL.min_readings)
    assert len(view.readings) == len(readings)
    return dense_solution(readings, field_map, independent.estimate)


def test_marginals_and_estimate_are_those_of_a_dense_solve(
    full: OneKeySolution, dense: Dense
) -> None:
    assert not full.unsettled | full.stayed
    for found in full.solved:
        own = slice(15 * found.sensor, 15 * found.sensor + 15)
        expected, sigma = dense.covariance[own, own], np.sqrt(np.diag(found.covariance))
        scale = np.outer(sigma, sigma)
        # Weights of the rounds' last estimate but one against those of the first: a thousandth.
        np.testing.assert_allclose(found.covariance / scale, expected / scale, rtol=0, atol=3e-3)
        # A round's last step is at most a hundredth of a sigma.
        away = (full.estimate.vector(found.sensor) - dense.theta[own]) / sigma
        np.testing.assert_allclose(away, 0, atol=0.02)


def test_both_uncertainties_agree_on_the_estimate(
    full: OneKeySolution, independent: OneKeySolution
) -> None:
    for ours in full.solved:
        sigma = np.sqrt(np.diag(ours.covariance))
        apart = full.estimate.vector(ours.sensor) - independent.estimate.vector(ours.sensor)
        assert np.abs(apart / sigma).max() < 1


def test_correlated_errors_make_a_calibration_less_sure(
    full: OneKeySolution, independent: OneKeySolution
) -> None:
    for ours, theirs in zip(full.solved, independent.solved, strict=True):
        ratio = eigh(ours.covariance, theirs.covariance, eigvals_only=True)
        # Errors that neighbours share cancel where only differences count, to a little.
        assert ratio.min() > 0.9
        assert ratio.max() > 1.5


def test_the_truth_is_within_the_stated_error(full: OneKeySolution) -> None:
    for found in full.solved:
        e = full.estimate.vector(found.sensor) - SENSORS[found.sensor].vector()
        # One draw of fifteen degrees of freedom: 44 at one in ten thousand.
        assert e @ np.linalg.solve(found.covariance, e) < 44


def test_sensors_share_the_maps_error(
    readings: Readings, field_map: HarmonicMap, full: OneKeySolution
) -> None:
    """A second sensor's readings correct the map that the first one uses, and never harm."""
    alone = solve_one_key(readings.select(readings.sensor == 0), field_map, STARTS, FULL)
    ratio = eigh(full.solved[0].covariance, alone.solved[0].covariance, eigvals_only=True)
    # The modes of the map's error are chosen at the readings: of both, or of one alone.
    assert ratio.max() < 1.1
    assert ratio.min() < 0.99


def test_an_exact_map_has_no_errors_to_carry(readings: Readings) -> None:
    """Maps without ``errors_over`` are solved as before, whatever is asked for."""
    assert not isinstance(WORLD, UncertainMap)
    one, other = (
        solve_one_key(readings, WORLD, STARTS, options) for options in (FULL, INDEPENDENT)
    )
    np.testing.assert_array_equal(one.estimate.t, other.estimate.t)
    for a, b in zip(one.solved, other.solved, strict=True):
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_the_noise_of_the_sensors_is_found_beside_the_maps_error(
    readings: Readings, field_map: HarmonicMap
) -> None:
    """Errors that the modes explain are not counted as noise."""
    found = solve_one_key(readings, field_map, STARTS, OneKeyOptions())
    # 450 residuals of each sensor, some fifteen parameters and the map's modes taken out.
    np.testing.assert_allclose(found.estimate.noise, NOISE, rtol=0.15)


def test_a_sensor_without_readings_does_not_disturb_the_others(
    readings: Readings, field_map: HarmonicMap
) -> None:
    thin = readings.select((readings.sensor == 0) | (np.arange(len(readings)) % 20 == 0))
    found = solve_one_key(thin, field_map, STARTS, FULL)
    assert [s.sensor for s in found.solved] == [0]
    assert np.isfinite(found.solved[0].covariance).all()


def test_a_sensor_that_leaves_the_map_on_the_way_is_not_settled() -> None:
    """A faint field, a poor map: readings leave it and return, and nothing is claimed."""
    rng, count = np.random.default_rng(5), 1500
    faint = DipoleWorld(CALM.uniform, CALM.positions, 0.03 * CALM.moments)
    points = rng.uniform([-1.5, -1.5, 0.2], [1.5, 1.5, 0.8], (150, 3))
    field = faint.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    weak = GIVEN.model_copy(update={"floor_scale": 0.048, "ceiling_scale": 0.015})
    options = OPTIONS.model_copy(update={"hyperparameters": weak})
    poor = HarmonicMap.fit(points, field, options)
    R, p = turning_poses(rng, count)
    t = np.array([0.1, 0.0, 0.05])
    b = np.einsum("nji,nj->ni", R, faint.field_and_gradient(R @ t + p)[0])
    b = b + rng.normal(0, NOISE, b.shape)
    stamps, sensor = np.arange(count) * 50_000_000, np.zeros(count, dtype=np.int64)
    lost = solve_one_key(Readings(("mag",), sensor, stamps, R, p, b), poor, t[None], FULL)
    assert not lost.solved or lost.unsettled | lost.stayed


def array(sigma: float, off: float) -> Priors:
    """Return a baseline between both sensors that is wrong by so many metres along x."""
    vector = SENSORS[1].t_lidar_mag - SENSORS[0].t_lidar_mag + np.array([off, 0.0, 0.0])
    return Priors((Difference((0, 1), vector, np.full(3, sigma), "baseline"),))


def test_a_tight_baseline_makes_two_sensors_one(
    readings: Readings, field_map: HarmonicMap, full: OneKeySolution
) -> None:
    """Known to a micrometre, their places differ by it and have one covariance, a smaller one."""
    found = solve_one_key(readings, field_map, STARTS, FULL, priors=array(1e-6, 0.0))
    apart = SENSORS[1].t_lidar_mag - SENSORS[0].t_lidar_mag
    np.testing.assert_allclose(found.estimate.t[1] - found.estimate.t[0], apart, atol=1e-5)
    one, other = (each.covariance[:3, :3] for each in found.solved)
    np.testing.assert_allclose(one, other, atol=1e-3 * np.trace(one))
    for before in full.solved:
        # The baseline adds information, so that the difference of covariances is positive.
        gain = before.covariance[:3, :3] - one
        assert np.linalg.eigvalsh(gain).min() > -1e-3 * np.trace(one)
    assert not any(each.contradictions for each in found.solved)


@pytest.mark.parametrize("options", [FULL, INDEPENDENT])
def test_a_wrong_baseline_is_contradicted(
    readings: Readings, field_map: HarmonicMap, options: OneKeyOptions
) -> None:
    """Half a metre off; both ways to a covariance see it."""
    found = solve_one_key(readings, field_map, STARTS, options, priors=array(0.01, 0.5))
    assert [each.sensor for each in found.solved] == [0, 1]
    for each in found.solved:
        (contradiction,) = each.contradictions
        assert contradiction.sensors == (0, 1)
        assert contradiction.sigmas > 4


def test_a_baseline_of_no_weight_changes_nothing(
    readings: Readings, field_map: HarmonicMap, full: OneKeySolution
) -> None:
    """Known to ten kilometres it makes a cluster of both and says nothing: to 1e-5 of variances."""
    loose = solve_one_key(readings, field_map, STARTS, FULL, priors=array(1e4, 0.0))
    for before, after in zip(full.solved, loose.solved, strict=True):
        size = np.sqrt(np.outer(*[np.diag(before.covariance)] * 2))
        np.testing.assert_allclose(
            after.covariance / size, before.covariance / size, rtol=0, atol=1e-5
        )
        assert after.figures.chi2_per_dof == pytest.approx(before.figures.chi2_per_dof, rel=1e-6)
