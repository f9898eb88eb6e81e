"""The chi-square distribution, without the time that ``scipy.stats`` takes to load."""

from typing import Any

import numpy as np
from scipy.special import chdtrc, chndtrinc, gammainccinv, gammaincinv, gammaln, xlogy

from l2m_gtsam.data import FloatArray


def quantile(share: Any, freedom: Any) -> FloatArray:
    """Return what this share of all values is below, with so many degrees of freedom.

    NaN where there is no freedom.
    """
    return np.asarray(2 * gammaincinv(_known(freedom) / 2, share))


def chance_beyond(value: Any, freedom: Any) -> FloatArray:
    """Return the share of all values that are above a value; one where that is below zero.

    NaN where there is no freedom.
    """
    return np.asarray(chdtrc(_known(freedom), np.maximum(value, 0.0)))


def exceeded_by(share: Any, freedom: Any) -> FloatArray:
    """Return what this share of all values is above, to full precision for the smallest shares.

    NaN where there is no freedom.
    """
    return np.asarray(2 * gammainccinv(_known(freedom) / 2, share))


def noticed_sigmas(freedom: int, chance: float, missed: float) -> float:
    """Return how long a mean of so many coordinates has to be for a test to notice it.

    In standard deviations: of values with such a mean the squared length is of a noncentral
    chi-square distribution.

    Parameters
    ----------
    freedom
        Number of coordinates.
    chance
        Share of means of zero that the test takes for another.
    missed
        Share of such means that it misses.
    """
    return float(np.sqrt(chndtrinc(exceeded_by(chance, freedom), freedom, missed)))


def density(value: FloatArray, freedom: float) -> FloatArray:
    """Return the density at values of zero or more."""
    half = freedom / 2
    return np.asarray(np.exp(xlogy(half - 1, value) - value / 2 - gammaln(half) - half * np.log(2)))


def _known(freedom: Any) -> FloatArray:
    return np.where(np.asarray(freedom) > 0, freedom, np.nan)
