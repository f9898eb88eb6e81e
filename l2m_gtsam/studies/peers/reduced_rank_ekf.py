"""The magnetic SLAM of F. Viset, R. Helmons and M. Kok (Sensors 2022), after the paper.

An extended Kalman filter of position, heading and the weights of a potential field in a box
(:mod:`l2m_gtsam.maps.potential`). Steps and turns of odometry are added to the pose along the axes
of the world, and each reading updates pose and weights together. Not iterated, no smoothing.
"""

from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_factors import skew
from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.geometry import from_ros
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.options import Options

POSE = 6
EARTH_UT = 50.0  # the published parameters are shares of a field of about this strength


class ReducedRankEkfOptions(Options):
    """Parameters of the filter; the published ones are the defaults."""

    prior: PotentialHyperparameters = PotentialHyperparameters(sigma=EARTH_UT, length=0.8)
    """Of the field."""
    functions: int = Field(default=50, ge=1)
    """Eigenfunctions; the published program chooses 50 for runs 1, 2 and 4, and 100 for run 3."""
    margin_m: float = Field(default=1.0, gt=0)
    """The box reaches so far beyond the path. The published program takes the true path."""
    noise_ut: float = Field(default=0.1 * EARTH_UT, gt=0)
    """Standard deviation of a reading per axis."""
    level_variance: float = Field(default=1.01e-3, ge=0)
    """Of a step along x and y, m^2,"""
    vertical_variance: float = Field(default=1e-7, ge=0)
    """along z, m^2,"""
    turn_variance: float = Field(default=1e-5, ge=0)
    """and of its turn about each axis, rad^2."""

    def basis_about(self, box: FloatArray) -> PotentialBasis:
        """Return the field's functions in a box about a path with these corners, shape (2, 3)."""
        low, high = box[0] - self.margin_m, box[1] + self.margin_m
        return PotentialBasis.over(low, high, self.prior, self.functions)


def reduced_rank_ekf(
    odometry: Trajectory, field: FloatArray, box: FloatArray, options: ReducedRankEkfOptions
) -> Trajectory:
    """Return the filter's poses with their covariances, each from the readings until then.

    Parameters
    ----------
    odometry
        N poses, one for each reading. The first is the start, which is exact.
    field
        Readings along the axes of the vehicle in uT, shape (N, 3).
    box
        Lower and upper corner of the path in metres, shape (2, 3).
    options
        Parameters of the filter.
    """
    basis = options.basis_about(box)
    weights = np.zeros(len(basis))
    P = np.zeros((POSE + len(basis), POSE + len(basis)))
    P[POSE:, POSE:] = np.diag(basis.variance)
    Q = np.zeros_like(P)
    level, turn = options.level_variance, options.turn_variance
    own = [level, level, options.vertical_variance, turn, turn, turn]
    Q[:POSE, :POSE] = np.diag(own)
    steps = np.diff(odometry.p, axis=0)
    turns = odometry.R[1:] @ odometry.R[:-1].transpose(0, 2, 1)
    noise = options.noise_ut**2 * np.eye(3)
    R, p = [odometry.R[0]], [odometry.p[0]]
    covariance = [P[:POSE, :POSE]]
    for step, turned, reading in zip(steps, turns, field[1:], strict=True):
        at, axes, P = p[-1] + step, turned @ R[-1], P + Q
        features = basis.features(at[None])[0]
        predicted, gradient = features @ weights, basis.slopes(at[None])[0] @ weights
        H = np.hstack([gradient, skew(predicted[None])[0], features])
        S = H @ P @ H.T + noise
        K = np.linalg.solve(S, H @ P).T
        change = K @ (axes @ reading - predicted)
        P = P - K @ S @ K.T
        P = 0.5 * (P + P.T)
        weights = weights + change[POSE:]
        p.append(at + change[:3])
        R.append(Rotation.from_rotvec(change[3:POSE]).as_matrix() @ axes)
        covariance.append(P[:POSE, :POSE])
    rotations = np.stack(R)
    # Of p and rotation along the axes of the world, as in ROS.
    stated = from_ros(np.stack(covariance), rotations)
    return replace(odometry, R=rotations, p=np.stack(p), covariance=stated)
