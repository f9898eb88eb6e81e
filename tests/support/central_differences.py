"""Derivatives by central differences, to compare analytic ones with."""

from collections.abc import Callable

import numpy as np

from l2m_gtsam.data import FloatArray


def slopes(of: Callable[[FloatArray], FloatArray], points: FloatArray, step: float) -> FloatArray:
    """Derivatives along x, y and z at points of shape (N, 3), the axis last."""
    return np.stack(
        [(of(points + step * e) - of(points - step * e)) / (2 * step) for e in np.eye(3)], axis=-1
    )
