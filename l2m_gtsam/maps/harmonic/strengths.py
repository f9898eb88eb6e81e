"""How strong each structure is: its own prior scale, and whether the readings show it at all."""

import numpy as np
from scipy.optimize import Bounds, minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import Normal, evidence, inverse_of, whitened_factor
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
        Sums over the readings.
    hyperparameters
        Shared by the map.
    """
    pairs = [
        (columns, family.strength)
        for columns, family in zip(basis.columns(), basis.families, strict=True)
        if isinstance(family, Dipoles)
    ]
    if not pairs:
        return []
    columns = [pair[0] for pair in pairs]
    given = np.log([pair[1] for pair in pairs])
    base = basis.prior(hyperparameters).log_variance

    def log_variance(x: FloatArray) -> FloatArray:
        trial = base.copy()
        for at, log_strength, start in zip(columns, x, given, strict=True):
            trial[at] += 2 * (log_strength - start)
        return trial

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        result = evidence(normal, log_variance(x), hyperparameters.noise)
        slope = np.array([2 * result.by_log_variance[at].sum() for at in columns])
        return -result.value, -slope

    low, high = np.log(RANGE)
    end = minimize(
        cost,
        given,
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low, high),
        options={"maxiter": STEPS, "ftol": 1e-9},
    )
    # At the maximum the slope vanishes, and what remains of it counts the determined weights.
    determined = determined_weights(normal, log_variance(end.x), hyperparameters.noise)
    return [
        float(np.exp(x)) if determined[at].sum() >= LEAST_DETERMINED else 0.0
        for x, at in zip(end.x, columns, strict=True)
    ]


def determined_weights(normal: Normal, log_variance: FloatArray, noise: float) -> FloatArray:
    """Return the share of each weight's prior variance that the readings removed, shape (m,)."""
    K = whitened_factor(normal, np.exp(0.5 * log_variance), noise)
    return np.asarray(1.0 - np.diag(inverse_of(K)))
