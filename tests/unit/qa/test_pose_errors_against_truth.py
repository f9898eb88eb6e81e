"""Errors of poses against the truth: as evo has them, and honest where covariances are."""

from dataclasses import replace

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import SyncError
from l2m_gtsam.qa.metrics.trajectory import (
    ComparedTrajectories,
    check_truth,
    compared,
    truth_record,
)
from l2m_gtsam.slam.drive import EXACT_START

STEP_NS = 100_000_000


def trajectory(rng: np.random.Generator, count: int = 30) -> Trajectory:
    stamps = 1_700_000_000_000_000_000 + STEP_NS * np.arange(count)
    R = Rotation.random(count, rng=rng).as_matrix()
    return Trajectory(stamps, R, rng.normal(0, 5, (count, 3)), "map", "lidar")


def perturbed(truth: Trajectory, error: FloatArray) -> Trajectory:
    """Return poses of which the truth is a right perturbation, ``T_true = T Exp(error)``.

    To first order in the translation.
    """
    R = truth.R @ Rotation.from_rotvec(error[:, :3]).as_matrix().transpose(0, 2, 1)
    return replace(truth, R=R, p=truth.p - np.einsum("nij,nj->ni", R, error[:, 3:]))


def as_evo(found: Trajectory) -> PoseTrajectory3D:
    quaternions = Rotation.from_matrix(found.R).as_quat(scalar_first=True)
    return PoseTrajectory3D(found.p, quaternions, 1e-9 * found.stamp_ns)


@given(st.integers(0, 2**32 - 1))
def test_errors_are_those_of_evo(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = trajectory(rng)
    found = perturbed(truth, rng.normal(0, 0.3, (30, 6)))
    figures = compared(truth, found).figures()
    for relation, rms, largest in (
        (metrics.PoseRelation.translation_part, figures.rms_m, figures.largest_m),
        (metrics.PoseRelation.rotation_angle_deg, figures.rms_deg, figures.largest_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data((as_evo(truth), as_evo(found)))
        # Rounding, of an angle that evo takes from a trace.
        assert rms == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
        assert largest == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), rel=1e-6)


def test_nees_is_honest_where_covariances_are() -> None:
    rng = np.random.default_rng(5)
    count = 4000
    root = rng.normal(size=(count, 6, 6)) * np.repeat([0.01, 0.05], 3)[:, None]
    covariance = root @ root.transpose(0, 2, 1)
    truth = trajectory(rng, count)
    error = np.einsum("nij,nj->ni", root, rng.normal(size=(count, 6)))
    found = replace(perturbed(truth, error), covariance=covariance)
    record = truth_record(truth, ComparedTrajectories(found, found), 1.0)
    assert record is not None
    # The mean of 4,000 chi-squares of six has a standard deviation of 0.055, the share 0.0034.
    assert record.nees == pytest.approx(6, abs=0.22)
    assert record.beyond_95 == pytest.approx(0.05, abs=0.014)
    bold = truth_record(
        truth, ComparedTrajectories(replace(found, covariance=covariance / 4), found), 1.0
    )
    assert bold is not None
    assert bold.nees == pytest.approx(4 * record.nees, rel=1e-9)


def test_a_first_pose_that_defines_the_frame_does_not_count() -> None:
    """A degree that the truth has at the start is thousands of sigmas of a pose that is held."""
    rng = np.random.default_rng(8)
    count = 500
    sigma = np.repeat([0.01, 0.05], 3)
    error, covariance = (
        sigma * rng.normal(size=(count, 6)),
        np.tile(np.diag(sigma**2), (count, 1, 1)),
    )
    error[0], covariance[0] = np.repeat([0.01, 0.0], 3), EXACT_START
    truth = trajectory(rng, count)
    found = replace(perturbed(truth, error), covariance=covariance)
    as_it_is = truth_record(truth, ComparedTrajectories(found, found), 1.0)
    record = truth_record(truth, ComparedTrajectories(found, found, from_first=True), 1.0)
    assert as_it_is is not None
    assert record is not None
    assert as_it_is.nees > 60
    # The mean of 499 chi-squares of six has a standard deviation of 0.16.
    assert record.nees == pytest.approx(6, abs=0.6)
    assert np.isnan(record.squared[0])
    assert record.poses == count
    held = found[np.arange(1)]
    alone = truth_record(truth, ComparedTrajectories(held, held, from_first=True), 1.0)
    assert alone is not None
    assert np.isnan(alone.nees)


def test_truth_is_interpolated_within_its_time_only() -> None:
    rng = np.random.default_rng(6)
    truth = trajectory(rng, 10)
    halfway = truth.stamp_ns[:-1] + STEP_NS // 2
    p = (truth.p[1:] + truth.p[:-1]) / 2
    found = Trajectory(halfway, truth.R[:-1], p, "map", "lidar", np.tile(np.eye(6), (9, 1, 1)))
    away = replace(found, p=p + np.array([3.0, 0, 4.0]))
    half = replace(truth, stamp_ns=truth.stamp_ns[:5], R=truth.R[:5], p=truth.p[:5])
    record = truth_record(half, ComparedTrajectories(found, away), 0.2)
    assert record is not None
    assert record.poses == 4
    assert record.localised.largest_m < 1e-9
    assert record.odometry.rms_m == pytest.approx(5.0)
    assert record.removed == pytest.approx(1.0)
    assert np.isnan(record.odometry_m[4:]).all()
    assert truth_record(half, ComparedTrajectories(found, away), 0.05) is None


def test_a_truth_of_another_time_is_an_error() -> None:
    truth = trajectory(np.random.default_rng(7))
    later = replace(truth, stamp_ns=truth.stamp_ns + 3_600_000_000_000)
    check_truth(truth, truth, 0.5, "truth.tum")
    with pytest.raises(SyncError, match=r"truth\.tum: runs from 1700000000\.000 .* one clock"):
        check_truth(truth, later, 0.5, "truth.tum")
