r"""Steps of an odometry that drifts steadily along fixed axes: by a current, wind, or a slope.

What is added to each step is ``W_k v`` along the axes of the frame of the poses, with v common to
all steps: its first three components come with time, the others with the distance. With the turn R
and the way p of a step along the axes of the vehicle

.. math::
    e = Log(Z^{-1} X_k^{-1} X_{k+1}), \quad Z = (R, p - R_k^T W_k v)

and with the turn R and the way d along the axes of the frame of the poses

.. math::
    e = [Log(R_k^T R^T R_{k+1}), R_{k+1}^T (p_{k+1} - p_k - d + W_k v)]
"""

import gtsam
import numpy as np

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.fixed_axes_step import fixed_axes_residual
from l2m_factors.joint_residual import Residual
from l2m_factors.keys import V, X
from l2m_factors.motion import skew


def drifting_step(key_pose: int, step: gtsam.Pose3, weights: FloatArray) -> Residual:
    """Return what odometry says of a step from ``X(k)`` to ``X(k+1)``, but for its drift ``V()``.

    It is a right perturbation of the step, rotation (rad) before translation (m).

    Parameters
    ----------
    key_pose
        Number k of the key pose before the step.
    step
        The next key pose in its frame, with the drift.
    weights
        Metres that one unit of the drift with time, and of that with distance, adds to the step,
        shape (2,); or along each axis of the frame of the poses, shape (2, 3).
    """
    R, W = step.rotation(), drift_weights(weights)

    def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        before, after = values.atPose3(X(key_pose)), values.atPose3(X(key_pose + 1))
        back = before.rotation().matrix().T
        drift = back @ W @ values.atVector(V())
        off = gtsam.Pose3(R, step.translation() - drift).between(before.between(after))
        if jacobians is not None:
            by_off = gtsam.Pose3.LogmapDerivative(off)
            # The drift as a right perturbation of the step.
            by_drift = (-by_off @ off.inverse().AdjointMap())[:, 3:] @ -R.matrix().T
            by_before = -by_off @ before.between(after).inverse().AdjointMap()
            by_before[:, :3] += by_drift @ skew(drift[None])[0]
            jacobians[0], jacobians[1], jacobians[2] = by_before, by_off, by_drift @ back @ W
        return np.asarray(gtsam.Pose3.Logmap(off))

    return Residual([X(key_pose), X(key_pose + 1), V()], 6, error)


def drifting_fixed_axes_step(
    key_pose: int, turn: gtsam.Rot3, way: FloatArray, weights: FloatArray
) -> Residual:
    """Return the same of odometry that knows its steps along fixed axes.

    Parameters
    ----------
    key_pose, turn, way
        As of ``fixed_axes_step_factor``; the way is with the drift.
    weights
        As of ``drifting_step``.

    Raises
    ------
    ValueError
        The way is not of three finite numbers.
    """
    W, way = drift_weights(weights), numbers("way", way, (3,))

    def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        poses = [values.atPose3(X(key_pose + end)) for end in (0, 1)]
        if jacobians is not None:
            back = poses[1].rotation().matrix().T
            jacobians[2] = np.vstack([np.zeros((3, 6)), back @ W])
        return fixed_axes_residual(poses, turn, way - W @ values.atVector(V()), jacobians)

    return Residual([X(key_pose), X(key_pose + 1), V()], 6, error)


def drift_weights(weights: FloatArray) -> FloatArray:
    """Return W, what a unit of each component of the drift adds to a step in m, shape (3, 6).

    Parameters
    ----------
    weights
        As of ``drifting_step``.
    """
    along_axes = np.broadcast_to(np.reshape(weights, (2, -1)), (2, 3))
    return np.hstack([np.diag(each) for each in along_axes])
