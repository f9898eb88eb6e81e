"""The chi-square distribution, without the time that ``scipy.stats`` takes to load."""

from typing import Any

import numpy as np
from scipy.special import chdtrc, gammaincinv, gammaln, xlogy

from l2m_gtsam.data import FloatArray


def quantile(share: Any, freedom: Any) -> FloatArray:
    """Return what this share of all values is below, with so many degrees of freedom."""
    return np.asarray(2 * gammaincinv(np.asarray(freedom) / 2, share))


def chance_beyond(value: Any, freedom: Any) -> FloatArray:
    """Return the share of all values that are above a value."""
    return np.asarray(chdtrc(freedom, value))


def density(value: FloatArray, freedom: float) -> FloatArray:
    """Return the density at values of zero or more."""
    half = freedom / 2
    return np.asarray(np.exp(xlogy(half - 1, value) - value / 2 - gammaln(half) - half * np.log(2)))
