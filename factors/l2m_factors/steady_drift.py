r"""Steps of an odometry that drifts steadily: by a current, wind or a slope, or by turning.

What is added to each step is ``W_k v`` along the axes of the frame of the poses, with v common to
all steps: the turn ``u_k``, about one axis as by a gyroscope's bias or by unequal wheels, and the
way ``s_k``. With the turn R and the way p of a step along the axes of the vehicle

.. math::
    e = Log(Z^{-1} X_k^{-1} X_{k+1}), \quad Z = (Exp(-R_k^T u_k) R, p - R_k^T s_k)

and with the turn R and the way d along the axes of the frame of the poses

.. math::
    e = [Log(R_k^T R^T Exp(u_k) R_{k+1}), R_{k+1}^T (p_{k+1} - p_k - d + s_k)]
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
        shape (2,); or along each axis of the frame of the poses, shape (2, 3). Or what one unit of
        each of n components adds along these axes, a turn about one axis (rad) before the way (m),
        shape (6, n).
    """
    W = drift_weights(weights)

    def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        before, after = values.atPose3(X(key_pose)), values.atPose3(X(key_pose + 1))
        back, added = before.rotation().matrix().T, W @ values.atVector(V())
        turn, drift = back @ added[:3], back @ added[3:]
        turned = gtsam.Rot3.Expmap(-turn)
        without = gtsam.Pose3(turned.compose(step.rotation()), step.translation() - drift)
        off = without.between(before.between(after))
        if jacobians is not None:
            by_off = gtsam.Pose3.LogmapDerivative(off)
            by_before = -by_off @ before.between(after).inverse().AdjointMap()
            # Turn and drift as a right perturbation of the step: turns about one axis add up, and
            # both keep their axes in the frame where the pose before turns.
            by_step, axes = by_off @ off.inverse().AdjointMap(), without.rotation().matrix().T
            by_turn, by_drift = by_step[:, :3] @ axes, by_step[:, 3:] @ axes
            by_before[:, :3] += by_turn @ (np.eye(3) - turned.matrix())
            by_before[:, :3] += by_drift @ skew(drift[None])[0]
            by_added = by_turn @ back @ W[:3] + by_drift @ back @ W[3:]
            jacobians[0], jacobians[1], jacobians[2] = by_before, by_off, by_added
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
        added = W @ values.atVector(V())
        without = gtsam.Rot3.Expmap(-added[:3]).compose(turn)
        found = fixed_axes_residual(poses, without, way - added[3:], jacobians)
        if jacobians is not None:
            back, by_turn = poses[1].rotation().matrix().T, jacobians[1][:3, :3]
            jacobians[2] = np.vstack([by_turn @ back @ W[:3], back @ W[3:]])
        return found

    return Residual([X(key_pose), X(key_pose + 1), V()], 6, error)


def drift_weights(weights: FloatArray) -> FloatArray:
    """Return W, what a unit of each component of the drift adds to a step, shape (6, n).

    Parameters
    ----------
    weights
        As of ``drifting_step``.
    """
    if len(weights) == 6:
        return np.asarray(weights, dtype=np.float64)
    along_axes = np.broadcast_to(np.reshape(weights, (2, -1)), (2, 3))
    ways = np.hstack([np.diag(each) for each in along_axes])
    return np.vstack([np.zeros_like(ways), ways])
