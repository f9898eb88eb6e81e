r"""What earlier readings still say of a field that has changed since.

Between two drives each weight of a tile may have moved by a random step, which leaves its prior as
it is:

.. math::
    w_{before} = \sqrt{1 - \rho^2} \, w_{after} + \rho \, \xi, \quad w_{after}, \xi \sim N(0, S)

With the step integrated out, sums over earlier readings become sums over the weights as they are
now: with ``rho = 0`` the same, with one nothing is left of them. How far the weights moved is what
makes the readings of both drives most likely together. A tile without new readings has no step:
nothing is forgotten by its age.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.evidence import Normal, evidence


@dataclass(frozen=True)
class Faded:
    """Sums over earlier readings for the weights as they are after a step.

    Attributes
    ----------
    normal
        The sums.
    log_det
        Logarithm of the determinant that belongs to their likelihood.
    """

    normal: Normal
    log_det: float


def faded(normal: Normal, prior_sigma: FloatArray, noise: float, moved: FloatArray) -> Faded:
    """Return the sums over readings after a step of the weights.

    Parameters
    ----------
    normal
        Sums for m weights as they were; ``Fy`` may have columns, shape (m,) or (m, k).
    prior_sigma
        Standard deviations of the weights' prior, shape (m,).
    noise
        Of a reading of weight one in uT.
    moved
        rho of each weight, 0 to 1, shape (m,).
    """
    if not moved.any():
        return Faded(normal, 0.0)
    free = np.flatnonzero(moved)
    root = prior_sigma[free] * moved[free] / noise
    A = normal.FF[np.ix_(free, free)] * (root[:, None] * root)
    A[np.diag_indices_from(A)] += 1.0
    K = cholesky(A, lower=True, check_finite=False)
    m = len(moved)
    columns = normal.Fy.reshape(m, -1)
    right = np.hstack([normal.FF[free], columns[free]]) * root[:, None]
    half = solve_triangular(K, right, lower=True, check_finite=False)
    known = half[:, :m].T @ half
    first, alike = half[:, m], np.sqrt(1 - moved**2)
    after = Normal(
        (normal.FF - known[:, :m]) * (alike[:, None] * alike),
        ((columns - known[:, m:]) * alike[:, None]).reshape(normal.Fy.shape),
        normal.yy - float(first @ first),
        normal.rows,
        normal.log_weight,
    )
    return Faded(after, 2 * float(np.log(np.diag(K)).sum()))


def carried(
    normals: Sequence[Normal], moved: Sequence[FloatArray], prior_sigma: FloatArray, noise: float
) -> Normal:
    """Return the sums over the readings of all drives for the weights after the last one.

    Parameters
    ----------
    normals
        Of each drive, in order.
    moved
        Of each weight from each drive to the next, one fewer, shapes (m,).
    prior_sigma, noise
        As for ``faded``.
    """
    total = normals[0]
    for normal, each in zip(normals[1:], moved, strict=True):
        total = faded(total, prior_sigma, noise, each).normal + normal
    return total


def likelihood(
    before: Normal, new: Normal, log_variance: FloatArray, noise: float, moved: FloatArray
) -> float:
    """Return how likely readings before and after a step are, in nats.

    Parameters
    ----------
    before, new
        Sums over the readings before and after.
    log_variance
        Of the prior of the weights, shape (m,).
    noise
        In uT.
    moved
        rho of each weight, shape (m,).
    """
    old = faded(before, np.exp(0.5 * log_variance), noise, moved)
    return evidence(old.normal + new, log_variance, noise).value - 0.5 * old.log_det


def share_left(normal: Normal, prior_sigma: FloatArray, noise: float, moved: FloatArray) -> float:
    """Return what is left of the information of readings after a step, 0 to 1.

    The mean over the weights that the readings know better than the prior.
    """
    gain = np.maximum(np.diag(normal.FF), 0.0) * (prior_sigma / noise) ** 2
    after = np.maximum(np.diag(faded(normal, prior_sigma, noise, moved).normal.FF), 0.0)
    known = gain > 1
    left = after[known] * (prior_sigma[known] / noise) ** 2 / gain[known]
    return float(np.clip(np.mean(left), 0.0, 1.0)) if known.any() else 1.0
