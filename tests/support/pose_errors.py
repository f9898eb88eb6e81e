"""Errors of poses and trajectories against the truth."""

from collections.abc import Sequence

import gtsam
import numpy as np
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.studies.statistics import nees


def pose_errors(found: Sequence[gtsam.Pose3], truth: Sequence[gtsam.Pose3]) -> FloatArray:
    """Return what poses are off by, as right perturbations, shape (K, 6)."""
    return np.stack([gtsam.Pose3.Logmap(a.between(b)) for a, b in zip(found, truth, strict=True)])


def mean_nees(
    found: Sequence[gtsam.Pose3], covariance: FloatArray, truth: Sequence[gtsam.Pose3]
) -> float:
    """Return the mean of squared pose errors in sigmas: 6 where covariances are true."""
    return float(nees(pose_errors(found, truth), covariance).mean())


def at(trajectory: Trajectory, stamps: IntArray) -> PoseTrajectory3D:
    """Return poses at stamps that they have, as evo takes them."""
    rows = np.searchsorted(trajectory.stamp_ns, stamps)
    quaternions = Rotation.from_matrix(trajectory.R[rows]).as_quat(scalar_first=True)
    return PoseTrajectory3D(trajectory.p[rows], quaternions, 1e-9 * trajectory.stamp_ns[rows])


def position_error(truth: Trajectory, found: Trajectory) -> float:
    """Return evo's absolute pose error in metres, rms, without any alignment."""
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((at(truth, found.stamp_ns), at(found, found.stamp_ns)))
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


def pose_nees(truth: Trajectory, found: Trajectory) -> FloatArray:
    """Return the squared pose errors in sigmas; consistent sigmas give a mean of 6."""
    assert found.covariance is not None
    rows = np.searchsorted(truth.stamp_ns, found.stamp_ns)
    R_back = found.R.transpose(0, 2, 1)
    turn = Rotation.from_matrix(R_back @ truth.R[rows]).as_rotvec()
    shift = np.einsum("nij,nj->ni", R_back, truth.p[rows] - found.p)
    return nees(np.hstack([turn, shift]), found.covariance)
