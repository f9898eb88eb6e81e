"""Covariances of poses and sensors from a solved graph."""

import gtsam
import numpy as np

from l2m_factors import D, T, X
from l2m_gtsam.data import FloatArray


def pose_covariances(marginals: gtsam.Marginals, count: int) -> FloatArray:
    """Return those of right perturbations of so many key poses, shape (K, 6, 6)."""
    return np.stack([marginals.marginalCovariance(X(k)) for k in range(count)])


def sensor_covariances(marginals: gtsam.Marginals, count: int) -> FloatArray:
    """Return those of (t, C row by row, H) of so many sensors in m and uT, shape (S, 15, 15)."""
    blocks = []
    for i in range(count):
        keys = [T(i), D(i)]
        joint = marginals.jointMarginalCovariance(keys)
        blocks.append(np.block([[joint.at(a, b) for b in keys] for a in keys]))
    return np.stack(blocks)
