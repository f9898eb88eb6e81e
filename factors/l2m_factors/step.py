r"""Readings between two key poses: what the error of odometry's step adds to them.

A reading after a share s of the step from ``X(k)`` to ``X(k+1)`` stands at ``X(k) (R, p)`` if the
step is Z. With ``d = Log(Z^{-1} X(k)^{-1} X(k+1))`` it stands elsewhere by ``s d``, and

.. math::
    e = e(X(k)) + G d

with G the derivative of the residual by d where the graph is linearised. For the best result
readings are hung anew, by the step as it is estimated then; there d is zero, and e is exact.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_factors.arguments import noise_of, numbers
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.keys import G, X
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

    @property
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
