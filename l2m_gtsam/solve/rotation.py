"""The rotation in a distortion matrix, by convention its proper polar factor."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError

AXES = "xyz"


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
        det C <= 0: an axis is mirrored and no rotation fits; the message names it.
    """
    if not np.linalg.det(C) > 0:
        msg = (
            f"det C = {np.linalg.det(C):.3g}: the sensor's {flipped_axis(C)} axis looks flipped; "
            "reverse it in the driver or with `bag.axes`, a rotation cannot"
        )
        raise CalibrationError(msg)
    U, s, Vt = np.linalg.svd(C)
    R = np.asarray(U @ Vt)
    P = Vt.T @ np.diag(s) @ Vt
    skew = np.zeros((3, 9))
    for axis in range(3):
        i, j = (axis + 2) % 3, (axis + 1) % 3  # M[i, j] - M[j, i] of M = R^T dC
        for row in range(3):
            skew[axis, 3 * row + j] += R[row, i]
            skew[axis, 3 * row + i] -= R[row, j]
    J = R @ np.linalg.solve(np.trace(P) * np.eye(3) - P, skew)
    return PolarRotation(R, _propagated(J, covariance))


def _propagated(J: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return ``J covariance J^T``; what rests on an infinite variance is infinite itself."""
    unknown = np.isinf(np.diag(covariance))
    finite = np.where(unknown[:, None] | unknown, 0.0, covariance)
    result = J @ finite @ J.T
    # 1e-9 separates a part that is zero but for rounding from one that is not.
    open_ = np.abs(J[:, unknown]).max(axis=1, initial=0.0) > 1e-9
    result[open_, :] = 0.0
    result[:, open_] = 0.0
    result[open_, open_] = np.inf
    return np.asarray(result)


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
