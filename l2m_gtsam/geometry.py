"""Rotations, and covariances of poses from the axes of ROS to those of GTSAM or another body."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import BoolArray, FloatArray, RigidTransform
from l2m_gtsam.errors import CalibrationError


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


NEARLY_HALF = 3.0  # rad: beyond, the axis of a turn is in the symmetric part of its matrix
TINY = 1e-150  # its square is a number still


def turn_angle(R: FloatArray) -> FloatArray:
    """Return the angles of rotations in rad, shapes (..., 3, 3) and (...)."""
    # |R - I|^2 = 8 sin^2(angle / 2), which keeps the digits of small angles.
    chord = np.sqrt(np.square(R - np.eye(3)).sum(axis=(-2, -1)) / 8)
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def interpolated_rotations(R: FloatArray, at: FloatArray, between: FloatArray) -> FloatArray:
    """Interpolate rotations along the shortest arcs, shape (N, 3, 3).

    SciPy's ``Slerp`` takes a hundred times as long to begin, and is asked near half turns alone.

    Parameters
    ----------
    R
        Rotations, shape (M, 3, 3), M of at least two.
    at
        Their times, increasing, shape (M,).
    between
        Times of those that are wanted, within these, shape (N,).
    """
    row = np.clip(np.searchsorted(at, between, side="right") - 1, 0, len(at) - 2)
    turn = R[:-1].transpose(0, 2, 1) @ R[1:]
    angle = turn_angle(turn)
    if angle.max() > NEARLY_HALF:
        return np.asarray(Slerp(at, Rotation.from_matrix(R))(between).as_matrix())
    fraction = (between - at[row]) / np.diff(at)[row]
    # Rodrigues: exp(f W) of W = (turn - turn^T) / 2, whose length is sin(angle).
    W, whole = 0.5 * (turn - turn.transpose(0, 2, 1)), np.maximum(np.sin(angle), TINY)
    first = np.sin(fraction * angle[row]) / whole[row]
    second = 2.0 * (np.sin(0.5 * fraction * angle[row]) / whole[row]) ** 2
    part = np.eye(3) + first[:, None, None] * W[row] + second[:, None, None] * (W @ W)[row]
    return np.asarray(R[row] @ part)


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


AXES = "xyz"
SINGULAR = 0.1  # of the largest singular value of C: no sensor's is as flat, mirrored or not


@dataclass(frozen=True)
class PolarRotation:
    """The rotation from lidar to sensor in ``C = R_mag_lidar @ P`` with P symmetric positive.

    Attributes
    ----------
    R_mag_lidar
        Rotation, shape (3, 3).
    covariance
        Covariance of the error in rad^2, with true ``R = exp(error) @ R_mag_lidar``, (3, 3).
    """

    R_mag_lidar: FloatArray
    covariance: FloatArray


def polar_rotation(C: FloatArray, covariance: FloatArray) -> PolarRotation:
    """Return the rotation in C and, by the delta method, its covariance.

    From ``R^T dC = [w]x P + dP`` the symmetric part drops out, and
    ``[w]x P + P [w]x = [(tr(P) I - P) w]x``.

    Parameters
    ----------
    C
        Distortion matrix, shape (3, 3).
    covariance
        Covariance of C row by row, shape (9, 9).

    Raises
    ------
    CalibrationError
        det C <= 0: an axis is mirrored and no rotation fits, and the message names it; or C is flat
        and its sign says nothing.
    """
    U, s, Vt = np.linalg.svd(C)
    volume = np.linalg.det(C)
    if not volume > 0 and s[-1] < SINGULAR * s[0]:
        raise CalibrationError(
            f"det C = {volume:.3g}: C is nearly singular, as no sensor's is: the drive hardly "
            "determines it; drive with all headings and some tilt, or give what is known of the "
            "sensor"
        )
    if not volume > 0:
        raise CalibrationError(
            f"det C = {volume:.3g}: the sensor's {flipped_axis(C)} axis looks flipped; reverse it "
            "in the driver or with `bag.axes`, a rotation cannot"
        )
    R = np.asarray(U @ Vt)
    P = Vt.T @ np.diag(s) @ Vt
    skew = np.zeros((3, 9))
    for axis in range(3):
        i, j = (axis + 2) % 3, (axis + 1) % 3  # M[i, j] - M[j, i] of M = R^T dC
        for row in range(3):
            skew[axis, 3 * row + j] += R[row, i]
            skew[axis, 3 * row + i] -= R[row, j]
    J = R @ np.linalg.solve(np.trace(P) * np.eye(3) - P, skew)
    return PolarRotation(R, propagated(J, covariance))


def propagated(J: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``J covariance J^T``; what rests on an infinite variance is infinite itself."""
    unknown = ~np.isfinite(np.diag(covariance))
    # The delta method; 0 * inf is no number, so that infinite variances are propagated apart.
    finite = np.where(unknown[:, None] | unknown, 0.0, covariance)
    # 1e-9 separates a part that is zero but for rounding from one that is not.
    rests_on_them = np.abs(J[:, unknown]).max(axis=1, initial=0.0) > 1e-9
    return undetermined(J @ finite @ J.T, rests_on_them)


def undetermined(covariance: FloatArray, which: BoolArray) -> FloatArray:
    """Return a covariance, (n, n), with infinite variance of some and no correlation, (n,)."""
    left = np.where(which[:, None] | which, 0.0, covariance)
    left[which, which] = np.inf
    return left


def dead_axis(C: FloatArray) -> str | None:
    """Return the sensor axis that does not follow the field, if one does not.

    Its row of C is less than a tenth of the longest: scale and soft iron stay well above that.
    """
    gain = np.linalg.norm(C, axis=1)
    return AXES[int(np.argmin(gain))] if gain.min() < 0.1 * gain.max() else None


def flipped_axis(C: FloatArray) -> str:
    """Return the sensor axis whose reversal makes C most like a mounting along the lidar."""
    likeness = []
    for axis in range(3):
        turned = C.copy()
        turned[axis] *= -1
        U, _, Vt = np.linalg.svd(turned)
        likeness.append(np.trace(U @ Vt))
    return AXES[int(np.argmax(likeness))]
