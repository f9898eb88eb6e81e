"""The one-key solve with pose errors that last, against generalised least squares."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.pose_errors import error_of_poses
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.solve.robust import Loss, RobustOptions
from tests.drives.uncertain import (
    NOISE,
    SENSORS,
    STARTS,
    all_features,
    dense_rows,
    own_noise,
)

LASTS_S = 0.7
OPTIONS = OneKeyOptions(
    sensor_noise_ut=NOISE,
    warp_m=0,
    pose_noise=PoseNoiseOptions(correlation_s=LASTS_S),
    robust=RobustOptions(loss=Loss.SQUARED),
)


@pytest.fixture(scope="module")
def uncertain(readings: Readings, field_map: HarmonicMap) -> Readings:
    """Those of the first sensor in one tile: elsewhere tiles cut a segment's bridge in two.

    Roots are those of 1 cm and 0.3 deg, mixed.
    """
    x = np.einsum("nij,j->ni", readings.R_map_lidar, SENSORS[0].t_lidar_mag)
    owner = field_map.errors_over(x + readings.p_map_lidar).owner(x + readings.p_map_lidar)
    own = readings.sensor == 0
    tile = np.bincount(owner[own]).argmax()
    some = readings.select(own & (owner == tile))
    rng = np.random.default_rng(3)
    root = np.diag(np.repeat([np.deg2rad(0.3), 0.01], 3)) @ (
        np.eye(6) + 0.3 * rng.normal(size=(len(some), 6, 6))
    )
    return replace(some, sensors=some.sensors[:1], pose_root=root)


@pytest.fixture(scope="module")
def solution(uncertain: Readings, field_map: HarmonicMap) -> OneKeySolution:
    return solve_one_key(uncertain, field_map, STARTS[:1], OPTIONS)


def noise_covariance(readings: Readings, field_map: HarmonicMap, estimate: Estimate) -> FloatArray:
    """Return the covariance of all residuals, shape (3 N, 3 N), readings in order."""
    C, N = estimate.C()[0], len(readings)
    x = np.einsum("nij,j->ni", readings.R_map_lidar, estimate.t[0]) + readings.p_map_lidar
    errors, R_lidar_map = field_map.errors_over(x), readings.R_map_lidar.transpose(0, 2, 1)
    A = all_features(errors, x)
    CR = C @ R_lidar_map
    own = own_noise(field_map, x, A, CR)
    by_map = (CR @ A).reshape(3 * N, -1)
    seconds = 1e-9 * readings.stamp_ns
    like = np.exp(-np.abs(seconds[:, None] - seconds) / LASTS_S)
    by_pose = (C @ error_of_poses(readings, field_map, estimate)).reshape(3 * N, 6)
    return np.asarray(
        block_diag(*own)
        + by_map @ errors.covariance @ by_map.T
        + (by_pose @ by_pose.T) * np.kron(like, np.ones((3, 3)))
    )


def test_marginals_and_estimate_are_those_of_all_covariances_at_once(
    uncertain: Readings, field_map: HarmonicMap, solution: OneKeySolution
) -> None:
    estimate, (found,) = solution.estimate, solution.solved
    assert not solution.unsettled | solution.stayed
    e, J = dense_rows(
        uncertain,
        field_map,
        np.concatenate([estimate.vector(0)] * len(SENSORS)),
        np.zeros((len(uncertain), 3, 0)),
    )
    J = J[:, :, :15].reshape(-1, 15)
    noise = noise_covariance(uncertain, field_map, estimate)
    ridge = estimate.ridge[0] * np.diag(np.repeat([0.0, 1.0, 0.0], [3, 9, 3]))
    information = J.T @ np.linalg.solve(noise, J) + ridge
    expected, sigma = np.linalg.inv(information), np.sqrt(np.diag(found.covariance))
    scale = np.outer(sigma, sigma)
    # Derivatives by C are taken with the errors' estimates in the field: a hundredth.
    np.testing.assert_allclose(found.covariance / scale, expected / scale, rtol=0, atol=0.02)
    ideal = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
    pull = J.T @ np.linalg.solve(noise, e.ravel()) + ridge @ (estimate.vector(0) - ideal)
    # What a Newton step of the marginal model still wants, in sigmas.
    assert np.abs(expected @ pull / sigma).max() < 0.1


def test_errors_of_poses_make_a_calibration_less_sure(
    uncertain: Readings, field_map: HarmonicMap, solution: OneKeySolution
) -> None:
    sure = solve_one_key(replace(uncertain, pose_root=None), field_map, STARTS[:1], OPTIONS)
    (one,), (other,) = solution.solved, sure.solved
    assert (np.diag(one.covariance) > np.diag(other.covariance)).all()


def test_errors_that_vanish_change_nothing(uncertain: Readings, field_map: HarmonicMap) -> None:
    tiny = replace(uncertain, pose_root=np.broadcast_to(1e-9 * np.eye(6), (len(uncertain), 6, 6)))
    one, other = (
        solve_one_key(each, field_map, STARTS[:1], OPTIONS)
        for each in (tiny, replace(uncertain, pose_root=None))
    )
    sigma = np.sqrt(np.diag(other.solved[0].covariance))
    away = (one.estimate.vector(0) - other.estimate.vector(0)) / sigma
    # Each stops within a hundredth of a sigma of the optimum.
    np.testing.assert_allclose(away, 0, atol=0.02)
    np.testing.assert_allclose(
        one.solved[0].covariance / np.outer(sigma, sigma),
        other.solved[0].covariance / np.outer(sigma, sigma),
        atol=3e-3,
    )


def independently_wrong(field_map: HarmonicMap, seed: int, rotation_deg: float) -> Readings:
    """Readings of the first sensor on a level drive in the field of the map itself.

    Each has a pose that is turned by an error of its own.
    """
    rng, count = np.random.default_rng(seed), 2000
    angles = np.column_stack([rng.uniform(-np.pi, np.pi, count), rng.normal(0, 0.02, (count, 2))])
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    p = np.column_stack([rng.uniform(-1.1, 1.1, (count, 2)), rng.uniform(0.4, 0.6, count)])
    B, _ = field_map.field_and_gradient(R @ SENSORS[0].t_lidar_mag + p)
    b = np.einsum("nji,nj->ni", R, B)
    sigma = np.deg2rad(rotation_deg)
    wrong = R @ Rotation.from_rotvec(rng.normal(0, sigma, (count, 3))).as_matrix()
    return Readings(
        sensors=(SENSORS[0].sensor,),
        sensor=np.zeros(count, dtype=np.int64),
        stamp_ns=np.arange(count) * 10_000_000,
        R_map_lidar=wrong,
        p_map_lidar=p,
        field=SENSORS[0].distortion.apply(b) + rng.normal(0, NOISE, (count, 3)),
        pose_root=np.broadcast_to(np.diag(np.repeat([sigma, 1e-6], 3)), (count, 6, 6)),
    )


@pytest.mark.parametrize("uncertainty", Uncertainty)
def test_errors_that_each_pose_has_of_its_own_do_not_shrink_C(
    field_map: HarmonicMap, uncertainty: Uncertainty
) -> None:
    alone = OPTIONS.pose_noise.model_copy(update={"correlation_s": 0.0})
    options = OPTIONS.model_copy(update={"pose_noise": alone, "uncertainty": uncertainty})
    truth, squared = np.concatenate([SENSORS[0].t_lidar_mag, SENSORS[0].distortion.vector()]), []
    for seed in range(2):
        solution = solve_one_key(
            independently_wrong(field_map, seed, 0.8), field_map, STARTS[:1], options
        )
        e, covariance = solution.estimate.vector(0) - truth, solution.solved[0].covariance
        squared.append(e @ np.linalg.solve(covariance, e))
    # The map is exact and its errors are counted all the same: 22 instead of 30 are expected.
    assert np.sum(squared) < chi2.ppf(0.999, 2 * 15)
