"""Linear factors of many rows as ones of few, without loss."""

from itertools import chain
from typing import Any

import gtsam
import numpy as np

JACOBIAN: Any = gtsam.JacobianFactor  # its stub lists one to three variables, each by itself


def linearised(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> gtsam.GaussianFactorGraph:
    """Return a graph's quadratic with few rows: each factor's are replaced by their QR.

    Factors have three variables at most if they have more rows than columns.
    """
    linear, zero = graph.linearize(values), values.zeroVectors()
    smaller = gtsam.GaussianFactorGraph()
    for index in range(linear.size()):
        factor = linear.at(index)
        widths = [len(zero.at(key)) for key in list(factor.keys())]
        smaller.push_back(fewer_rows(factor, widths))
    return smaller


def fewer_rows(factor: gtsam.GaussianFactor, widths: list[int]) -> gtsam.GaussianFactor:
    """Return a factor with the same ``|A x - b|^2`` in one row more than columns, or fewer.

    Parameters
    ----------
    factor
        With at most three variables if it has more rows than that.
    widths
        Dimension of each of its variables.
    """
    jacobian, b = factor.jacobian()
    if len(b) <= sum(widths) + 1:
        return factor
    triangular = np.linalg.qr(np.column_stack([jacobian, b]), mode="r")
    terms = np.split(triangular, np.cumsum(widths), axis=1)
    unit = gtsam.noiseModel.Unit.Create(len(triangular))
    smaller: gtsam.GaussianFactor = JACOBIAN(
        *chain.from_iterable(zip(factor.keys(), terms[:-1], strict=True)), terms[-1].ravel(), unit
    )
    return smaller
