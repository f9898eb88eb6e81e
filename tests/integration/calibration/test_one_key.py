"""The one-key solve on exact maps: truth recovered, forms equal, uncertainty honest."""

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from l2m_gtsam.calibration import one_key
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.factor_graph import FactorForm
from l2m_gtsam.calibration.joint import joint_problem
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.optimise import Optimizer, covariance_by_qr, joint_covariance
from l2m_gtsam.calibration.sensor_columns import keys_of
from l2m_gtsam.calibration.view import observe
from l2m_gtsam.data import FloatArray, KnownSensor
from l2m_gtsam.records.error_budget import EXPLAINED
from l2m_gtsam.solve.closed_form import ClosedFormOptions, Method
from tests.worlds.exact import (
    BoundedWorld,
    DipoleWorld,
    dipole_world,
    drive,
    random_sensors,
)


def errors(solution: OneKeySolution, sensors: tuple[KnownSensor, ...]) -> FloatArray:
    found = [solution.estimate.vector(i) for i in range(len(sensors))]
    return np.stack(found) - np.stack([s.vector() for s in sensors])


@pytest.mark.parametrize("optimizer", list(Optimizer))
def test_noiseless_readings_give_the_truth(optimizer: Optimizer) -> None:
    """Exact map, no noise: t in m, C and H in uT to 1e-6 (issue contract), from the origin."""
    world, sensors = dipole_world(0), random_sensors(0, 4)
    readings = drive(1, sensors, world, count=300)
    options = OneKeyOptions(optimizer=optimizer)
    solution = solve_one_key(readings, world, np.zeros((4, 3)), options)
    assert len(solution.solved) == 4
    np.testing.assert_allclose(errors(solution, sensors), 0, atol=1e-6)


@pytest.mark.parametrize("method", list(Method))
def test_every_closed_form_leads_there(method: Method) -> None:
    world, sensors = dipole_world(3), random_sensors(3, 2)
    readings = drive(3, sensors, world, count=300)
    options = OneKeyOptions(closed_form=ClosedFormOptions(method=method))
    solution = solve_one_key(readings, world, np.zeros((2, 3)), options)
    np.testing.assert_allclose(errors(solution, sensors), 0, atol=1e-6)


def test_block_and_reading_factors_solve_alike() -> None:
    """The same optimum and covariance; optimisers stop within 1e-5 of a sigma of each other."""
    world, sensors = dipole_world(1), random_sensors(1, 2)
    readings = drive(2, sensors, world, count=150, noise=0.2)
    block, single = (
        solve_one_key(readings, world, np.zeros((2, 3)), OneKeyOptions(factors=form))
        for form in (FactorForm.BLOCK, FactorForm.READING)
    )
    for a, b in zip(block.solved, single.solved, strict=True):
        sigma = np.sqrt(np.diag(a.covariance))
        difference = block.estimate.vector(a.sensor) - single.estimate.vector(b.sensor)
        np.testing.assert_allclose(difference / sigma, 0, atol=1e-4)
        np.testing.assert_allclose(
            a.covariance / np.outer(sigma, sigma), b.covariance / np.outer(sigma, sigma), atol=1e-4
        )


def test_uncertainty_is_honest_where_the_map_is_exact() -> None:
    """NEES of all fifteen over 60 calibrations; its mean must lie in the chi-square 99.9 % band.

    The noise is estimated from 3 x 200 residuals, which widens the band by less than its width.
    """
    nees, noises = [], []
    for seed in range(15):
        world, sensors = dipole_world(seed), random_sensors(seed, 4)
        readings = drive(seed, sensors, world, count=200, noise=0.2)
        t_start = np.stack([s.t_lidar_mag for s in sensors]) + 0.05
        solution = solve_one_key(readings, world, t_start, OneKeyOptions())
        for found in solution.solved:
            e = errors(solution, sensors)[found.sensor]
            nees.append(e @ np.linalg.solve(found.covariance, e))
            noises.append(solution.estimate.noise[found.sensor])
    count = len(nees)
    band = [float(chi2.ppf(p, 15 * count)) / count for p in (0.0005, 0.9995)]
    assert count == 60
    assert band[0] < np.mean(nees) < band[1]
    # The mean of 60 estimates, each from 600 residuals, has a deviation of 0.4 %.
    assert np.mean(noises) == pytest.approx(0.2, rel=0.01)


def test_weights_that_never_settle_are_told() -> None:
    """One round from far away: the solution must not call itself settled."""
    world, sensors = dipole_world(1), random_sensors(1, 2)
    readings = drive(2, sensors, world, count=150, noise=0.2)
    assert not solve_one_key(readings, world, np.zeros((2, 3)), OneKeyOptions()).unsettled
    hasty = OneKeyOptions(max_steps=1, joint_iterations=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(one_key, "MAX_ROUNDS", 1)
        assert solve_one_key(readings, world, np.zeros((2, 3)), hasty).unsettled


class UniformWorld(DipoleWorld):
    """No gradient anywhere."""


def test_a_uniform_field_determines_no_position() -> None:
    """C and H are still calibrated; t stays at the start and is marked."""
    world = UniformWorld(np.array([22.0, 3.0, -38.0]), np.zeros((1, 3)), np.zeros((1, 3)))
    sensors = random_sensors(4, 1)
    readings = drive(4, sensors, world, count=300, tilt=0.4)
    start = np.array([[0.1, -0.2, 0.3]])
    solution = solve_one_key(readings, world, start, OneKeyOptions())
    found = solution.solved[0]
    assert sorted(found.determinacy.names) == ["t_x", "t_y", "t_z"]
    assert np.isinf(np.diag(found.covariance)[:3]).all()
    assert np.isfinite(np.diag(found.covariance)[3:]).all()
    np.testing.assert_allclose(solution.estimate.t, start, atol=1e-9)
    np.testing.assert_allclose(errors(solution, sensors)[0, 3:], 0, atol=1e-5)


def test_readings_outside_the_map_are_left_out() -> None:
    inner, sensors = dipole_world(6), random_sensors(6, 2)
    world = BoundedWorld(inner.uniform, inner.positions, inner.moments)
    readings = drive(6, sensors, world, count=300)
    solution = solve_one_key(readings, world, np.zeros((2, 3)), OneKeyOptions())
    t = np.stack([s.t_lidar_mag for s in sensors])[readings.sensor]
    x = np.einsum("nij,nj->ni", readings.R_map_lidar, t) + readings.p_map_lidar
    np.testing.assert_array_equal(solution.inside, x[:, 0] < 2.0)
    np.testing.assert_allclose(errors(solution, sensors), 0, atol=1e-6)


def test_a_sensor_without_readings_does_not_disturb_the_others() -> None:
    world, sensors = dipole_world(7), random_sensors(7, 3)
    readings = drive(7, sensors, world, count=200)
    thin = readings.select((readings.sensor != 1) | (np.arange(len(readings)) % 20 == 0))
    solution = solve_one_key(thin, world, np.zeros((3, 3)), OneKeyOptions())
    assert [s.sensor for s in solution.solved] == [0, 2]
    np.testing.assert_allclose(errors(solution, sensors)[[0, 2]], 0, atol=1e-6)


def test_given_noise_is_used() -> None:
    """With twice the noise stated, all sigmas double (no map variance here)."""
    world, sensors = dipole_world(9), random_sensors(9, 1)
    readings = drive(9, sensors, world, count=200, noise=0.1)
    sigma = []
    for noise in (0.1, 0.2):
        options = OneKeyOptions(sensor_noise_ut=noise)
        found = solve_one_key(readings, world, np.zeros((1, 3)), options).solved[0]
        assert found.unmodelled == EXPLAINED  # parts that scatter more, by chance, widen sigmas
        sigma.append(np.sqrt(np.diag(found.covariance)))
    np.testing.assert_allclose(sigma[1] / sigma[0], 2.0, rtol=1e-3)


def test_world_is_immutable_for_the_solver() -> None:
    """The solve works on copies: running it twice gives the same bits."""
    world, sensors = dipole_world(9), random_sensors(9, 2)
    readings = drive(9, sensors, world, count=100, noise=0.1)
    kept = replace(readings, field=readings.field.copy())
    first = solve_one_key(readings, world, np.zeros((2, 3)), OneKeyOptions())
    second = solve_one_key(kept, world, np.zeros((2, 3)), OneKeyOptions())
    np.testing.assert_array_equal(first.estimate.t, second.estimate.t)
    np.testing.assert_array_equal(first.estimate.distortion, second.estimate.distortion)


def refused(sensors: tuple[int, ...]) -> FloatArray:
    """Stand in for nothing: GTSAM has marginals of a graph in which all is known about alike."""
    raise AssertionError(sensors)


def test_both_ways_to_a_covariance_agree() -> None:
    """GTSAM's marginals and the QR that stands in for them, relative to the sigmas."""
    world, sensors = dipole_world(10), random_sensors(10, 2)
    readings = drive(10, sensors, world, count=150, noise=0.2)
    options = OneKeyOptions()
    estimate = solve_one_key(readings, world, np.zeros((2, 3)), options).estimate
    problem = joint_problem(observe(readings, world, estimate, 30), world, estimate, options)
    values = estimate.values([0, 1])
    linear = problem.graph.linearize(values)
    among = joint_covariance(linear, values, refused)
    for sensor in (0, 1):
        covariance = among((sensor,))
        other = covariance_by_qr(linear, (sensor,))
        sigma = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(
            other / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-6
        )


def spun_on_the_spot(seed: int, spread: float) -> tuple[gtsam.GaussianFactorGraph, gtsam.Values]:
    """Return the graph of a sensor that turns in a horizontal field of 20 uT, linearised.

    The vertical field varies by so many uT: the third column of C is hardly known beside H.
    """
    rng, N, (t, d, s) = np.random.default_rng(seed), 80, keys_of(0)
    heading = np.linspace(0, 6, N)
    b = np.column_stack([20 * np.cos(heading), 20 * np.sin(heading), np.full(N, -43.0)])
    b[:, 2] += spread * rng.normal(size=N)
    of_t, of_s = 3 * rng.normal(size=(3 * N, 3)), rng.normal(size=(3 * N, 1))
    of_C = np.kron(b, np.eye(3))[:, [0, 3, 6, 1, 4, 7, 2, 5, 8]]
    of_d = np.hstack([of_C, np.tile(np.eye(3), (N, 1))])
    graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create
    blocks = (t, 10 * of_t, d, 10 * of_d, s, 10 * of_s)
    graph.add(gtsam.JacobianFactor(*blocks, np.zeros(3 * N), unit(3 * N)))
    graph.add(gtsam.JacobianFactor(s, 1e6 * np.eye(1), np.zeros(1), unit(1)))
    values = gtsam.Values()
    for key, size in ((t, 3), (d, 12), (s, 1)):
        values.insert(key, np.zeros(size))
    return graph, values


def test_where_gtsam_refuses_a_covariance_it_is_that_by_qr() -> None:
    """Near its limit it refuses some systems at once, and others when it is asked for marginals."""
    for spread in np.geomspace(0.010, 0.0115, 5):
        for seed in range(30):
            linear, values = spun_on_the_spot(seed, float(spread))
            by_qr = partial(covariance_by_qr, linear)
            sigma = np.sqrt(np.diag(joint_covariance(linear, values, by_qr)((0,))))
            # Cholesky beside QR, with a condition of 1e4 and so one of 1e8 of the normal equations
            np.testing.assert_allclose(sigma, np.sqrt(np.diag(by_qr((0,)))), rtol=1e-3)
