"""Covariances of poses: from the order and axes of ROS to those of GTSAM, and to another body.

ROS has the order (x, y, z, rx, ry, rz) and the axes of the header's frame: the position is wrong
by a vector given there, and the body is turned about its own origin by a rotation vector given
there, ``p_true = p + dp`` and ``R_true = Exp(dr) @ R``. A right perturbation (w, v) of GTSAM has
the order (rotation, translation) and the axes of the body, ``R_true = R @ Exp(w)`` and, to first
order, ``p_true = p + R @ v``. Hence ``w = R.T @ dr`` and ``v = R.T @ dp``.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform


def from_ros(covariance: FloatArray, R: FloatArray) -> FloatArray:
    """Return covariances of right perturbations, as in ``Trajectory``.

    Parameters
    ----------
    covariance
        As in ROS messages, rad and m, shape (N, 6, 6).
    R
        Rotations from body to header frame, shape (N, 3, 3).
    """
    return _exchanged(covariance, R.swapaxes(1, 2))


def to_ros(covariance: FloatArray, R: FloatArray) -> FloatArray:
    """Return covariances as in ROS messages, shape (N, 6, 6); undoes ``from_ros``."""
    return _exchanged(covariance, R)


def isotropic_covariance(rotation_deg: float, position_m: float) -> FloatArray:
    """Return the covariance of a pose with equal sigmas of all axes, rotation first, (6, 6)."""
    return np.diag(np.repeat([np.deg2rad(rotation_deg), position_m], 3) ** 2)


def moved(covariance: FloatArray, T_body_other: RigidTransform) -> FloatArray:
    """Return the covariances of another body that is fixed to the first.

    Parameters
    ----------
    covariance
        Covariances of right perturbations of the first body's poses, shape (N, 6, 6).
    T_body_other
        The other body in the first one's frame.
    """
    adjoint = carried_back(T_body_other.R[None], T_body_other.t[None])[0]
    return np.asarray(adjoint @ covariance @ adjoint.T)


def carried_back(R: FloatArray, p: FloatArray) -> FloatArray:
    """Return what a right perturbation of a frame makes of poses in it, shape (K, 6, 6).

    ``T0 Exp(d) T = T0 T Exp(A d)`` for T of rotations (K, 3, 3) and positions (K, 3) in metres.
    """
    A = np.zeros((len(p), 6, 6))
    back = R.transpose(0, 2, 1)
    A[:, :3, :3] = A[:, 3:, 3:] = back
    A[:, 3:, :3] = -back @ np.cross(np.eye(3), p[:, None])  # the matrices [p]x
    return A


def _exchanged(covariance: FloatArray, turn: FloatArray) -> FloatArray:
    """Turn each of the four blocks by ``turn``, shape (N, 3, 3), and exchange the halves."""
    blocks = covariance.reshape(-1, 2, 3, 2, 3).swapaxes(2, 3)[:, ::-1, ::-1]
    by = turn[:, None, None]
    return np.asarray((by @ blocks @ by.swapaxes(3, 4)).swapaxes(2, 3).reshape(-1, 6, 6))


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
