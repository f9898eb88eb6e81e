r"""Complexity penalty: poses are not biased to where an unknown field fits more of the noise.

Poses X and the m weights of a tile are estimated together. At given poses the best weights fit the
noise of as many components of readings as they have effective parameters,

.. math::
    p(X) = \mathrm{tr}(K \Sigma), \quad K = F^T F / \sigma^2, \quad \Sigma = (K + I)^{-1}

and leave a cost of ``(3 N - p) / 2`` in the mean. That falls where p grows: nearer to the sources,
where features are larger and more of them can be fitted. So ``p / 2`` is added, by

.. math::
    d p = \mathrm{tr}(\Sigma \, dK \, \Sigma) = d \sum_i |\Sigma F(x_i)^T|^2 / \sigma_i^2

with Sigma held constant: a residual ``|Sigma F(x)^T| / sigma`` of each reading, linear in its
position about that when the tile was made, has the right gradient there, and after a few rounds the
mode is right. (C. Mallows, Technometrics 15, 1973, counts parameters in this way.)

That is for weights with a prior that is wider than learnt. With the prior as learnt, poses have a
density with the weights integrated out. Its cost has ``log |K + I| / 2`` (the volume) beside the
least cost of the weights, with the gradient

.. math::
    d \log |K + I| = \mathrm{tr}(\Sigma \, dK) = d \sum_i F(x_i) \Sigma F(x_i)^T / \sigma_i^2

and the penalty ``sqrt(F(x) Sigma F(x)^T) / sigma`` makes the mode that of this density.

Where the noise has only a share r of the assumed variance, the weights reduce the cost by no more
than ``r p / 2``, and a larger penalty pushes poses away from the sources. Mallows estimates the
noise from the residuals; ``ComplexityPenalty.scaled`` is for that.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.joint_residual import Residual
from l2m_factors.tile import TileBatch


@dataclass(frozen=True)
class ComplexityPenalty:
    """Shares of n readings in the penalty: of the parameters of a field, or of its volume.

    Attributes
    ----------
    at
        Positions in the anchor's frame at which they were linearised, metres, shape (n, 3).
    value
        Roots of the shares, shape (n,).
    slope
        Their gradients in 1/m, shape (n, 3).
    """

    at: FloatArray
    value: FloatArray
    slope: FloatArray

    def __getitem__(self, rows: npt.NDArray[np.int64]) -> "ComplexityPenalty":
        return ComplexityPenalty(self.at[rows], self.value[rows], self.slope[rows])

    def checked(self, count: int) -> "ComplexityPenalty":
        """Return a copy for so many readings; a ValueError if it is of another number of them."""
        return ComplexityPenalty(
            numbers("ComplexityPenalty.at", self.at, (count, 3)),
            numbers("ComplexityPenalty.value", self.value, (count,)),
            numbers("ComplexityPenalty.slope", self.slope, (count, 3)),
        )

    @property
    def parameters(self) -> float:
        """Effective number of parameters."""
        return float(self.value @ self.value)

    def scaled(self, of_noise: float) -> "ComplexityPenalty":
        """Return the penalty for noise with this share of the assumed variance."""
        root = float(np.sqrt(of_noise))
        return ComplexityPenalty(self.at, root * self.value, root * self.slope)


def effective_parameters_factor(
    batch: TileBatch, key_pose: int, penalty: ComplexityPenalty
) -> gtsam.CustomFactor | None:
    """Return the penalty's factor of a key pose's n readings; None where it has no variables.

    Parameters as of ``effective_parameters``.
    """
    residual = effective_parameters(batch, key_pose, penalty)
    return None if residual is None else residual.factor()


def effective_parameters(
    batch: TileBatch, key_pose: int, penalty: ComplexityPenalty
) -> Residual | None:
    """Return the residual of that factor, shape (n,); None where it has no variables.

    Parameters
    ----------
    batch
        Readings of a tile.
    key_pose
        Number k of the key pose.
    penalty
        Of the n readings.

    Raises
    ------
    ValueError
        There are no readings on the key pose, or the penalty is of another number of readings.
    """
    penalty = penalty.checked(len(batch.rows_of(key_pose)))
    keys = batch.place_keys_of(key_pose)
    if not keys:
        return None

    def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        where = batch.places(values, key_pose)
        if jacobians is not None:
            for slot, block in enumerate(batch.place_jacobians(values, key_pose, where)):
                jacobians[slot] = np.einsum("ni,nij->nj", penalty.slope, block)
        return np.asarray(
            penalty.value + np.einsum("ni,ni->n", penalty.slope, where.x - penalty.at)
        )

    return Residual(keys, len(penalty.value), error)
