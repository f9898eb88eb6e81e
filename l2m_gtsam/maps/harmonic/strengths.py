"""How strong each structure is: its own prior scale, and whether the readings show it at all."""

import numpy as np
from scipy.optimize import Bounds, minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import (
    Normal,
    evidence,
    inverse_of,
    marginalised,
    whitened_factor,
)
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters

RANGE = (1e-4, 1e3)  # of a strength, relative to the map's structure_scale
# A structure of which the readings determine less than half a weight is no structure.
LEAST_DETERMINED = 0.5
STEPS = 25


def learn_strengths(basis: Basis, normal: Normal, hyperparameters: Hyperparameters) -> list[float]:
    """Return the strength of each structure among a basis's families, in their order.

    Automatic relevance determination: the marginal likelihood is raised over the logarithm of
    every strength; a structure without evidence shrinks, and is given the strength 0 where the
    readings determine less than half a weight of it.

    Parameters
    ----------
    basis
        With the structures at the strength to start from.
    normal
        Sums over the readings, for m weights.
    hyperparameters
        Scales in uT, depths in metres and noise in uT of the map.
    """
    structures = [
        (np.arange(columns.start, columns.stop), family.strength)
        for columns, family in zip(basis.columns, basis.families, strict=True)
        if isinstance(family, Dipoles)
    ]
    if not structures:
        return []
    kept = np.concatenate([columns for columns, _ in structures])
    owner = np.repeat(np.arange(len(structures)), [len(columns) for columns, _ in structures])
    noise, prior = hyperparameters.noise, basis.prior(hyperparameters).log_variance
    # Floor, ceiling and uniform field stay as they are: integrated out once, not at each step.
    alone, given = marginalised(normal, kept, prior, noise), prior[kept]
    start = np.log([strength for _, strength in structures])

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        # A prior variance goes with the square of the strength, hence the factors of two.
        result = evidence(alone, given + 2 * (x - start)[owner], noise)
        slope = np.bincount(owner, result.slopes().by_log_variance).astype(np.float64)
        return -result.value, -2 * slope

    low, high = np.log(RANGE)
    end = minimize(
        cost,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low, high),
        options={"maxiter": STEPS, "ftol": 1e-7},
    )
    determined = determined_weights(alone, given + 2 * (end.x - start)[owner], noise)
    # Effective number of weights that the readings determine (MacKay 1992), by structure.
    count = np.bincount(owner, determined)
    return [
        float(np.exp(x)) if c >= LEAST_DETERMINED else 0.0
        for x, c in zip(end.x, count, strict=True)
    ]


def determined_weights(normal: Normal, log_variance: FloatArray, noise: float) -> FloatArray:
    """Return the share of each weight's prior variance that the readings removed, shape (m,)."""
    K = whitened_factor(normal, np.exp(0.5 * log_variance), noise)
    return np.asarray(1.0 - np.diag(inverse_of(K)))
