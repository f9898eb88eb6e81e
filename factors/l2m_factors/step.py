r"""Steps of odometry: between key poses, along fixed axes, with a steady drift, and at readings.

**At readings.** What the error of a step adds to the readings between its two key poses. A reading
after a share s of the step from ``X(k)`` to ``X(k+1)`` stands at ``X(k) (R, p)`` if the step is Z.
With ``d = Log(Z^{-1} X(k)^{-1} X(k+1))`` it stands elsewhere by ``s d``, and

.. math::
    e = e(X(k)) + G d

with G the derivative of the residual by d where the graph is linearised. For the best result
readings are hung anew, by the step as it is estimated then; there d is zero, and e is exact.

**Along fixed axes**, whatever the attitude is. A vehicle that measures its way and its turns
against fixed axes, such as a ship by beacons, turns no step and no later turn by an error of its
attitude. With the turn R and the way d along the axes of the frame of the poses

.. math::
    e = [Log(R_k^T R^T R_{k+1}), R_{k+1}^T (p_{k+1} - p_k - d)]

**With a steady drift**: by a current, wind or a slope, or by turning. What is added to each step is
``W_k v`` along the axes of the frame of the poses, with v common to all steps: the turn ``u_k``,
about one axis as by a gyroscope's bias or by unequal wheels, and the way ``s_k``. With the turn R
and the way p of a step along the axes of the vehicle

.. math::
    e = Log(Z^{-1} X_k^{-1} X_{k+1}), \quad Z = (Exp(-R_k^T u_k) R, p - R_k^T s_k)

and with the turn R and the way d along the axes of the frame of the poses

.. math::
    e = [Log(R_k^T R^T Exp(u_k) R_{k+1}), R_{k+1}^T (p_{k+1} - p_k - d + s_k)]
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from l2m_factors.arguments import noise_of, numbers
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.joint_residual import Residual
from l2m_factors.keys import G, V, X
from l2m_factors.motion import skew
from l2m_factors.whitening import Whitening


@dataclass(frozen=True)
class StepError:
    """What the error of a step adds to n readings on it.

    Attributes
    ----------
    key_pose
        Number k of the key pose before them.
    step
        Z, the step by which they hang on it: the next key pose in its frame.
    slope
        G, by a right perturbation of the step, uT/rad and uT/m, shape (n, 3, 6).
    """

    key_pose: int
    step: gtsam.Pose3
    slope: FloatArray

    def checked(self, count: int) -> "StepError":
        """Return a copy for so many readings; a ValueError if it is of another number of them."""
        slope = numbers("StepError.slope", self.slope, (count, 3, 6))
        return StepError(self.key_pose, self.step, slope)

    @cached_property
    def keys(self) -> list[int]:
        """The two key poses."""
        return [X(self.key_pose), X(self.key_pose + 1)]

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return ``G d`` in uT, shape (n, 3)."""
        off = gtsam.Pose3.Logmap(self.step.between(self._motion(values)))
        return np.asarray(self.slope @ off)

    def jacobians(self, values: gtsam.Values) -> list[FloatArray]:
        """Return its derivatives by the two key poses, shape (n, 3, 6) each."""
        motion = self._motion(values)
        off = self.step.between(motion)
        by_next = self.slope @ gtsam.Pose3.LogmapDerivative(off)
        return [-by_next @ motion.inverse().AdjointMap(), by_next]

    def _motion(self, values: gtsam.Values) -> gtsam.Pose3:
        before, after = (values.atPose3(key) for key in self.keys)
        return before.between(after)


class Slots:
    """The variables of a factor whose residual is a sum of terms that share some.

    Parameters
    ----------
    keys
        Of one block of derivatives after the other, some more than once.
    """

    def __init__(self, keys: list[int]) -> None:
        self.keys = list(dict.fromkeys(keys))
        self._slot = [self.keys.index(key) for key in keys]

    def fill(
        self, jacobians: list[FloatArray], whitening: Whitening, blocks: list[FloatArray]
    ) -> None:
        """Put in what whitening makes of the blocks, (n, 3, .) each; those of one key add up."""
        sums: dict[int, FloatArray] = {}
        for slot, block in zip(self._slot, blocks, strict=True):
            sums[slot] = sums[slot] + block if slot in sums else block
        for slot, block in sums.items():
            jacobians[slot] = whitening(block)


def scaled_step_factor(
    key_pose: int, step: gtsam.Pose3, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Return what odometry says of the way from ``X(k)`` to ``X(k+1)``, but for its scale ``G()``.

    Parameters
    ----------
    key_pose
        Number k of the key pose before the step.
    step
        The next key pose in its frame.
    noise
        Of a right perturbation of the step, rotation (rad) before translation (m), beside what the
        share does.

    Raises
    ------
    ValueError
        The noise is not of six components.
    """
    R, p = step.rotation(), step.translation()
    by_share = np.append(np.zeros(3), R.matrix().T @ p)  # as a right perturbation of Z

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        before, after = values.atPose3(X(key_pose)), values.atPose3(X(key_pose + 1))
        way = before.between(after)
        off = gtsam.Pose3(R, (1 + values.atDouble(G())) * p).between(way)
        if jacobians is not None:
            by_off = gtsam.Pose3.LogmapDerivative(off)
            jacobians[0] = -by_off @ way.inverse().AdjointMap()
            jacobians[1] = by_off
            jacobians[2] = -(by_off @ (off.inverse().AdjointMap() @ by_share))[:, None]
        return np.asarray(gtsam.Pose3.Logmap(off))

    return gtsam.CustomFactor(noise_of(noise, 6), [X(key_pose), X(key_pose + 1), G()], error)


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
