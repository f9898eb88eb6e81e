"""Minima within bounds, as learning looks for them over logarithms of what is positive."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import Bounds, OptimizeResult, minimize

from l2m_gtsam.data import BoolArray, FloatArray

STEPS, TOLERANCE = 15_000, 2.220446049250313e-09  # those of SciPy itself
ON_BOUND = 1e-6  # of a logarithm: so near a bound, a search has run into it

Cost = Callable[[FloatArray], tuple[float, FloatArray]]
"""A value and its derivatives, shape (n,)."""


def minimised(
    cost: Cost,
    start: FloatArray,
    low: FloatArray | float,
    high: FloatArray | float,
    steps: int = STEPS,
    tolerance: float = TOLERANCE,
) -> OptimizeResult:
    """Return where a cost is least between bounds, by L-BFGS-B.

    Parameters
    ----------
    cost
        What is minimised.
    start, low, high
        Where to begin, and the bounds, shape (n,) each.
    steps
        The most that are taken.
    tolerance
        Relative decrease of the cost that ends the search.
    """
    return minimize(
        cost,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low, high),
        options={"maxiter": steps, "ftol": tolerance},
    )


def on_bound(x: FloatArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which of n numbers are at one of their bounds, shape (n,)."""
    return np.asarray(np.minimum(x - low, high - x) < ON_BOUND)
