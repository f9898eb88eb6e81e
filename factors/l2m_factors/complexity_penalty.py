r"""What keeps poses from being drawn to where an unknown field takes up more noise.

Poses X and the m weights of a tile are estimated together. At given poses the best weights take up
the noise of so many readings' components as they have parameters in effect,

.. math::
    p(X) = \mathrm{tr}(K \Sigma), \quad K = F^T F / \sigma^2, \quad \Sigma = (K + I)^{-1}

and leave a cost of ``(3 N - p) / 2`` in the mean. That falls where p grows: nearer to the sources,
where features are larger and more of them can be fitted. So ``p / 2`` is added, by

.. math::
    d p = \mathrm{tr}(\Sigma \, dK \, \Sigma) = d \sum_i |\Sigma F(x_i)^T|^2 / \sigma_i^2

with Sigma held: a residual ``|Sigma F(x)^T| / sigma`` of each reading, linear in its place about
where the tile was laid, has the right slope there, and after a few rounds the mode is right.
(Mallows' C_p, 1973, counts parameters in the same way.)

Where the noise has but a share r of the variance that it is taken to have, weights take up no more
than ``r p / 2`` of cost, and more than that pushes poses away from the sources. Mallows takes the
noise from the residuals; so does who asks for a share of the penalty.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FloatArray
from l2m_factors.tile import TileBatch


@dataclass(frozen=True)
class ComplexityPenalty:
    """What n readings contribute to the number of parameters of the field that they teach.

    Attributes
    ----------
    at
        Places in the anchor's frame where they hold, metres, shape (n, 3).
    value
        Roots of the contributions, shape (n,).
    slope
        Their gradients in 1/m, shape (n, 3).
    """

    at: FloatArray
    value: FloatArray
    slope: FloatArray

    def __getitem__(self, rows: npt.NDArray[np.int64]) -> "ComplexityPenalty":
        return ComplexityPenalty(self.at[rows], self.value[rows], self.slope[rows])

    @property
    def parameters(self) -> float:
        """How many parameters the readings teach."""
        return float(self.value @ self.value)

    def share(self, of_noise: float) -> "ComplexityPenalty":
        """Return the penalty where the noise has this share of its assumed variance."""
        root = float(np.sqrt(of_noise))
        return ComplexityPenalty(self.at, root * self.value, root * self.slope)


def effective_parameters_factor(
    batch: TileBatch, key_pose: int, penalty: ComplexityPenalty
) -> gtsam.CustomFactor | None:
    """Return the factor of a key pose's n readings; none where it depends on nothing.

    Parameters
    ----------
    batch
        The readings.
    key_pose
        Number k of the key pose.
    penalty
        Of its readings.
    """
    keys = batch.place_keys_of(key_pose)
    if not keys:
        return None

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        where = batch.places(values, key_pose)
        if jacobians is not None:
            for slot, block in enumerate(batch.place_jacobians(key_pose, where)):
                jacobians[slot] = np.einsum("ni,nij->nj", penalty.slope, block)
        return np.asarray(
            penalty.value + np.einsum("ni,ni->n", penalty.slope, where.x - penalty.at)
        )

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(penalty.value)), keys, error)
