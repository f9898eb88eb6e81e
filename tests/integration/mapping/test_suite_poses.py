"""Errors of a survey's poses are in the sigmas of the sensors that it calibrates."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.progress import silent
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import CalibrationResult
from tests.drives.suite_surveys import QUICK, errors, suite, surveyed
from tests.worlds.surveyed import strange_hall

POSITION_M, ROTATION_DEG, LASTING_S = 0.02, 0.8, 2.0
EXACT = PoseNoiseOptions(position_m=0.0, rotation_deg=0.0)
STATED = PoseNoiseOptions(position_m=POSITION_M, rotation_deg=ROTATION_DEG, correlation_s=LASTING_S)
TRUTH, SEED = suite(2, 2), 6
PLAIN = QUICK.model_copy(update={"searches": 0})  # no steel stands beside the way


def misplaced(recording: Recording, seed: int) -> Recording:
    """Return a survey whose poses are wrong by errors that last: true = measured Exp(error)."""
    rng, true = np.random.default_rng([seed, 1]), recording.trajectory
    seconds = 1e-9 * (true.stamp_ns - true.stamp_ns[0])
    like = np.exp(-np.diff(seconds) / LASTING_S)
    u = rng.standard_normal((len(seconds), 6))
    for k, each in enumerate(like, start=1):
        u[k] = each * u[k - 1] + np.sqrt(1 - each**2) * u[k]
    turn, shift = np.deg2rad(ROTATION_DEG) * u[:, :3], POSITION_M * u[:, 3:]
    R = true.R @ Rotation.from_rotvec(-turn).as_matrix()
    moved = replace(true, R=R, p=true.p - np.einsum("nij,nj->ni", R, shift))
    return replace(recording, trajectory=moved)


def calibrated(seed: int, options: PoseNoiseOptions | None) -> CalibrationResult:
    recording = misplaced(surveyed(seed, TRUTH, strange_hall(2)), seed)
    return calibrate_suite([recording], None, PLAIN, silent, options)


def distances(result: CalibrationResult) -> FloatArray:
    """Return the squared distance of t of each sensor from the truth in the stated covariance."""
    off = errors(result, TRUTH)[:, :3]
    pairs = zip(off, result.sensors, strict=True)
    return np.array([e @ np.linalg.solve(each.covariance[:3, :3], e) for e, each in pairs])


@pytest.fixture(scope="module")
def found() -> CalibrationResult:
    return calibrated(SEED, None)


def test_errors_of_poses_are_found(found: CalibrationResult) -> None:
    assert [each for each in found.doubts if "the survey's poses are off" in each]


def test_errors_of_poses_widen_sigmas_and_move_nothing(found: CalibrationResult) -> None:
    stated, exact = calibrated(SEED, STATED), calibrated(SEED, EXACT)
    for of_found, wide, narrow in zip(found.sensors, stated.sensors, exact.sensors, strict=True):
        np.testing.assert_allclose(wide.t_lidar_mag, narrow.t_lidar_mag, atol=1e-12)
        for each in (of_found, wide):
            grown = np.diag(each.covariance)[:3] / np.diag(narrow.covariance)[:3]
            assert np.all(grown > 1.2)
    assert not [each for each in stated.doubts + exact.doubts if "poses are off" in each]


@pytest.mark.study
def test_sigmas_of_a_suite_hold_stated_errors_of_poses() -> None:
    """Over six surveys; 3 is expected of each, and where poses count as exact there is far more."""
    exact, stated = (
        np.array([distances(calibrated(seed, options)) for seed in range(3, 9)])
        for options in (EXACT, STATED)
    )
    # Twelve of three degrees of freedom, in pairs that share their poses: a third of 3 or so.
    assert 1.0 < stated.mean() < 6.0
    assert exact.mean() > 2 * stated.mean()
