"""The particle filter and the fixed-lag smoother: in their own model, and on a recording."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from l2m_factors import X, assert_jacobians_match
from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.maps.potential import PotentialBasis
from l2m_gtsam.studies.peers.fixed_lag import (
    WEIGHTS,
    FixedLagOptions,
    fixed_lag_slam,
    reading_of_field,
)
from l2m_gtsam.studies.peers.particle_filters import (
    ParticleSlamOptions,
    moments,
    particle_slam,
    systematic,
)
from l2m_gtsam.studies.peers.reduced_rank_ekf import ReducedRankEkfOptions, reduced_rank_ekf
from l2m_gtsam.studies.slam.methods import rms
from l2m_gtsam.studies.slam.recordings import SHIP, DriftRecipe, Form, drifted, ship_run

MODEL = ReducedRankEkfOptions()


def box_of(truth: Trajectory) -> FloatArray:
    return np.stack([truth.p.min(axis=0), truth.p.max(axis=0)])


def test_derivatives_of_a_reading_of_a_field() -> None:
    basis = PotentialBasis.over(np.zeros(3), np.array([4.0, 3.0, 2.0]), MODEL.prior, 30)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3.Ypr(1.0, 0.2, 0.3), np.array([1.0, 1.3, 0.8])))
    values.insert(WEIGHTS, np.random.default_rng(0).normal(size=len(basis)))
    factor = reading_of_field(basis, X(0), np.array([20.0, 3.0, -40.0]), MODEL.noise_ut)
    assert_jacobians_match(factor, values)


def test_particles_are_drawn_as_often_as_their_shares_say() -> None:
    shares = np.array([0.5, 0.25, 0.125, 0.125])
    drawn = systematic(np.repeat(shares / 25, 25), np.random.default_rng(0))
    # By one draw at even distances each is drawn its expected number of times, rounded.
    counts = np.bincount(drawn // 25, minlength=4)
    assert np.abs(counts - 100 * shares).max() <= 1


def test_moments_of_equal_particles_are_those_of_one() -> None:
    R = np.broadcast_to(gtsam.Rot3.Ypr(0.3, 0.1, -0.2).matrix(), (5, 3, 3))
    p, own = np.tile([1.0, 2.0, 3.0], (5, 1)), 1e-4 * np.eye(6)
    mean_R, mean_p, covariance = moments(R, p, np.full(5, 0.2), own)
    np.testing.assert_allclose(mean_R, R[0], atol=1e-12)
    np.testing.assert_allclose(mean_p, p[0], atol=1e-12)
    np.testing.assert_allclose(covariance, own, atol=1e-12)


@pytest.mark.parametrize("method", ["particles", "fixed lag"])
def test_without_errors_of_steps_peers_follow_the_filter(shared_data: Path, method: str) -> None:
    """Poses are known then, and all of them are the Kalman filter of the field's weights."""
    drive = ship_run(shared_data / SHIP, 1)
    first = np.arange(60)
    truth, field, box = drive.truth[first], drive.field[first], box_of(drive.truth)
    exact = MODEL.model_copy(
        update={"level_variance": 1e-12, "vertical_variance": 1e-12, "turn_variance": 1e-12}
    )
    found = reduced_rank_ekf(truth, field, box, exact)
    if method == "particles":
        options = ParticleSlamOptions(particles=5)
        other = particle_slam(truth, field, box, exact, options, seed=0)
    else:
        other = fixed_lag_slam(truth, field, box, exact, FixedLagOptions())
    np.testing.assert_allclose(other.p, found.p, atol=1e-4)


def test_particles_remove_drift_on_the_ship(shared_data: Path) -> None:
    drive = ship_run(shared_data / SHIP, 2)
    odometry = drifted(drive.truth, DriftRecipe(), Form.WORLD, 0)
    box, options = box_of(drive.truth), ParticleSlamOptions(particles=100)
    found = particle_slam(odometry, drive.field, box, MODEL, options, seed=0)
    # Seeds 0 to 2 leave 0.55 to 0.68 m of 1.32 to 1.38 m: half of the drift, with a margin.
    assert rms(found.p, drive.truth.p) < 2 / 3 * rms(odometry.p, drive.truth.p)
    few, first = ParticleSlamOptions(particles=20), np.arange(60)
    one, again = (
        particle_slam(odometry[first], drive.field[first], box, MODEL, few, seed=0)
        for _ in range(2)
    )
    np.testing.assert_array_equal(again.p, one.p)
