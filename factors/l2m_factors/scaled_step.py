r"""A step of odometry whose way is too short by a share that all steps have in common.

With the step (R, p) as it was measured and the share s the true one is taken to be
``Z(s) = (R, (1 + s) p)``, and

.. math::
    e = Log(Z(s)^{-1} X(k)^{-1} X(k+1))
"""

import gtsam
import numpy as np

from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.keys import G, X


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

    return gtsam.CustomFactor(noise, [X(key_pose), X(key_pose + 1), G()], error)
