"""Rigid transforms: composed, compared, moved a little."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform

IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def compose(T_ab: RigidTransform, T_bc: RigidTransform) -> RigidTransform:
    """Return T_ac."""
    return RigidTransform(T_ab.R @ T_bc.R, T_ab.R @ T_bc.t + T_ab.t)


def between(T_ab: RigidTransform, T_ac: RigidTransform) -> RigidTransform:
    """Return T_bc."""
    return compose(T_ab.inverse(), T_ac)


def difference(T: RigidTransform, other: RigidTransform) -> FloatArray:
    """Return the right perturbation that leads from one to the other, shape (6,).

    Rotation vector in rad before translation in m, both in the axes of T; the translation is
    that of GTSAM's exponential to first order.
    """
    step = between(T, other)
    return np.concatenate([Rotation.from_matrix(step.R).as_rotvec(), step.t])


def perturbed(T: RigidTransform, error: FloatArray) -> RigidTransform:
    """Return T moved by a right perturbation, shape (6,); undoes ``difference``."""
    step = RigidTransform(Rotation.from_rotvec(error[:3]).as_matrix(), error[3:])
    return compose(T, step)


def as_matrix(T: RigidTransform) -> FloatArray:
    """Return a homogeneous matrix, shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = T.R, T.t
    return matrix


def from_matrix(matrix: FloatArray) -> RigidTransform:
    """Return the transform of a homogeneous matrix; its rotation is made exactly one."""
    R = Rotation.from_matrix(matrix[:3, :3]).as_matrix()
    return RigidTransform(R, np.array(matrix[:3, 3], dtype=np.float64))
