"""Arrays as the plain numbers of a file, rounded to what a picture shows."""

import numpy as np
from numpy.typing import ArrayLike

from l2m_gtsam.data import IntArray
from l2m_gtsam.records.record import Row, Rows


def row(values: ArrayLike, digits: int = 6) -> Row:
    """Return a vector as a tuple."""
    return tuple(np.round(np.asarray(values, dtype=float), digits).tolist())


def rows(values: ArrayLike, digits: int = 4) -> Rows:
    """Return a matrix as a tuple of its rows."""
    rounded = np.round(np.asarray(values, dtype=float), digits).tolist()
    return tuple(tuple(each) for each in rounded)


def evenly(count: int, most: int) -> IntArray:
    """Return at most so many indices below ``count``, evenly spread, first and last among them."""
    if count <= most:
        return np.arange(count)
    return np.round(np.linspace(0, count - 1, most)).astype(np.int64)
