"""Errors of trajectories against the truth."""

import numpy as np
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory


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
    error = np.hstack([turn, shift])[:, :, None]
    return np.asarray((error * np.linalg.solve(found.covariance, error)).sum(axis=(1, 2)))
