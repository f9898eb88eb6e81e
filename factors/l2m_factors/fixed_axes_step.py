r"""A step of odometry that is measured along fixed axes, whatever the attitude is.

A vehicle that measures its way and its turns against fixed axes, such as a ship by beacons, turns
no step and no later turn by an error of its attitude. With the turn R and the way d along the axes
of the frame of the poses

.. math::
    e = [Log(R_k^T R^T R_{k+1}), R_{k+1}^T (p_{k+1} - p_k - d)]
"""

import gtsam
import numpy as np

from l2m_factors.arguments import noise_of, numbers
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.keys import X
from l2m_factors.motion import skew


def fixed_axes_step_factor(
    key_pose: int, turn: gtsam.Rot3, way: FloatArray, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Return what odometry says of the way from ``X(k)`` to ``X(k+1)`` along fixed axes.

    Parameters
    ----------
    key_pose
        Number k of the key pose before the step.
    turn
        From one to the next about the axes that poses are in, ``R_{k+1} R_k^T``.
    way
        From one to the next along the axes that poses are in, metres, shape (3,).
    noise
        Of a right perturbation of the next pose, rotation (rad) before translation (m).

    Raises
    ------
    ValueError
        The way is not of three finite numbers, or the noise not of six components.
    """
    way = numbers("way", way, (3,))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        poses = [values.atPose3(X(key_pose + end)) for end in (0, 1)]
        return fixed_axes_residual(poses, turn, way, jacobians)

    return gtsam.CustomFactor(noise_of(noise, 6), [X(key_pose), X(key_pose + 1)], error)


def fixed_axes_residual(
    poses: list[gtsam.Pose3], turn: gtsam.Rot3, way: FloatArray, jacobians: Jacobians
) -> FloatArray:
    """Return e for the poses before and after a step, rad and metres, shape (6,).

    Parameters
    ----------
    poses
        Before and after the step.
    turn, way
        As of ``fixed_axes_step_factor``.
    jacobians
        Takes the derivatives by both poses, (6, 6) each, unless it is absent.
    """
    before, after = poses
    turned = before.rotation().between(after.rotation())
    off = turn.compose(before.rotation()).between(after.rotation())
    back = after.rotation().matrix().T
    apart = back @ (after.translation() - before.translation() - way)
    if jacobians is not None:
        by_turn = gtsam.Rot3.LogmapDerivative(gtsam.Rot3.Logmap(off))
        by_before, by_after = np.zeros((6, 6)), np.zeros((6, 6))
        by_before[:3, :3] = -by_turn @ off.matrix().T
        by_before[3:, 3:] = -turned.matrix().T
        by_after[:3, :3], by_after[3:, 3:] = by_turn, np.eye(3)
        by_after[3:, :3] = skew(apart[None])[0]
        jacobians[0], jacobians[1] = by_before, by_after
    return np.concatenate([gtsam.Rot3.Logmap(off), apart])
