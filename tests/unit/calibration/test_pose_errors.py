"""Pose errors: what they do to the field, and the process that they follow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.alternation import OneKeyOptions, start_estimate
from l2m_gtsam.calibration.pose_errors import (
    SEGMENTS,
    SHORT,
    PoseKnots,
    SegmentMeans,
    error_of_poses,
)
from tests.support.knots import left_open
from tests.worlds.exact import dipole_world, drive, random_sensors


@given(
    seed=st.integers(0, 1000),
    correlation=st.floats(1e-3, 100.0),
    length=st.floats(0.1, 500.0),
)
def test_knots_and_bridges_are_the_process(seed: int, correlation: float, length: float) -> None:
    """Their covariances add up to exp(-|dt| / T), within a segment and across; rounding."""
    rng = np.random.default_rng(seed)
    at = np.sort(rng.uniform(0, length, 40))
    between = max(correlation / 2, np.ptp(at) / SEGMENTS)
    assume(correlation > SHORT * between)
    knots = PoseKnots.over(at, correlation)
    apart = np.abs(knots.seconds[:, None] - knots.seconds)
    covariance = np.zeros((40, len(knots.seconds)))
    rows, before = np.arange(40), knots.segment(at)
    covariance[rows, before], covariance[rows, before + 1] = knots.weights(at).T
    total = covariance @ np.exp(-apart / correlation) @ covariance.T
    for segment in np.unique(before):
        own = np.flatnonzero(before == segment)
        total[np.ix_(own, own)] += left_open(knots, at[own])
    expected = np.exp(-np.abs(at[:, None] - at) / correlation)
    np.testing.assert_allclose(total, expected, atol=1e-9)


def test_knots_stand_as_close_as_errors_last_but_are_not_too_many() -> None:
    at = np.linspace(0, 100, 1000)
    assert PoseKnots.over(at, 20.0).spacing == pytest.approx(10.0)
    assert len(PoseKnots.over(at, 0.1).seconds) == 61
    alone = PoseKnots.over(np.array([3.0]), 1.0)
    np.testing.assert_allclose(left_open(alone, np.array([3.0])), 0, atol=1e-6)


@given(first=st.floats(0.0, 1e4), length=st.floats(1.0, 1e4))
def test_rounding_adds_no_segment(first: float, length: float) -> None:
    """A drive has just as many as are allowed, whenever it begins: another one moves all knots."""
    assert len(PoseKnots.over(np.array([first, first + length]), 1e-3).seconds) == SEGMENTS + 1


def test_errors_that_do_not_last_are_independent() -> None:
    at = np.linspace(0, 10, 7)[1:-1] + 0.01
    knots = PoseKnots.over(np.linspace(0, 10, 100), 0.0)
    # A mean over a sixth of a second of errors that last a microsecond: 1e-5 of their variance.
    np.testing.assert_allclose(knots.weights(at), 0, atol=1e-2)
    np.testing.assert_allclose(left_open(knots, at), np.eye(5), atol=1e-4)


@given(seed=st.integers(0, 1000), correlation=st.floats(0.03, 0.3))
def test_means_of_short_errors_are_what_times_of_a_segment_share(
    seed: int, correlation: float
) -> None:
    """With what is left they are the process; their own variance is that of many times' mean."""
    knots = PoseKnots.over(np.array([0.0, 120.0]), correlation)
    assert isinstance(knots, SegmentMeans)
    at = 4.0 + np.sort(np.random.default_rng(seed).uniform(0.0, 2.0, 30))  # one segment
    weights = knots.weights(at)
    total = left_open(knots, at) + weights @ weights.T
    np.testing.assert_allclose(total, np.exp(-np.abs(at[:, None] - at) / correlation), atol=1e-12)
    assert np.linalg.eigvalsh(left_open(knots, at)).min() > -1e-12
    fine = np.linspace(4.0, 6.0, 801)
    mean = np.exp(-np.abs(fine[:, None] - fine) / correlation).mean()
    # The mean over the weights is the deviation of the mean; sums stand for integrals.
    assert knots.weights(fine)[:, 0].mean() == pytest.approx(np.sqrt(mean), rel=1e-2)


def test_features_are_the_derivative_by_the_pose() -> None:
    """Central differences of b = R^T B(R t + p) over right perturbations; steps of 1e-5."""
    world, sensors = dipole_world(4), random_sensors(4, 2)
    readings = drive(4, sensors, world, count=5, tilt=0.5)
    root = np.random.default_rng(1).normal(size=(10, 6, 6))
    readings = replace(readings, pose_root=root)
    t = np.stack([s.t_lidar_mag for s in sensors])
    F = error_of_poses(readings, world, start_estimate(t, OneKeyOptions()))

    def field(error: np.ndarray) -> np.ndarray:
        R = readings.R_map_lidar @ Rotation.from_rotvec(error[:, :3]).as_matrix()
        p = readings.p_map_lidar + np.einsum("nij,nj->ni", readings.R_map_lidar, error[:, 3:])
        B, _ = world.field_and_gradient(np.einsum("nij,nj->ni", R, t[readings.sensor]) + p)
        return np.asarray(np.einsum("nji,nj->ni", R, B))

    for axis in range(6):
        step = 1e-5 * root[:, :, axis]
        expected = (field(step) - field(-step)) / 2e-5
        np.testing.assert_allclose(F[:, :, axis], expected, rtol=0, atol=1e-5 * np.abs(F).max())


def test_exact_poses_change_nothing() -> None:
    world, sensors = dipole_world(4), random_sensors(4, 1)
    readings = drive(4, sensors, world, count=5)
    t = np.stack([s.t_lidar_mag for s in sensors])
    assert not error_of_poses(readings, world, start_estimate(t, OneKeyOptions())).any()
