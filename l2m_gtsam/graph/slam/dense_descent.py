"""Least squares over some hundred variables that a dense Gaussian prior ties together.

GTSAM's optimisers eliminate variable by variable, which is slow where all of them hang together.
Here its factors are linearised and gathered in one dense system, that of one tile's readings at
a time, beside the prior's information, which is the same in each iteration.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.graph.slam.joint_gaussian import (
    ROUNDING,
    JointGaussian,
    columns_of,
    local,
    part_of,
    poses_among,
    retracted,
    slices_of,
)

CLOSE = 1.0  # squared length of a step in sigmas, of hundreds of variables together: the last one
DAMPINGS = (0.0, 1e-4, 1e-2, 1.0, 100.0)  # of a step, in units of the diagonal, one after the other
RISE = 1e-9  # of the cost, relative: rounding


class Prior:
    """A Gaussian prior of variables, in information form.

    Parameters
    ----------
    known
        What is known of them.
    """

    def __init__(self, known: JointGaussian) -> None:
        self._known = known
        sigma = np.sqrt(np.diag(known.covariance))
        correlation = known.covariance / np.outer(sigma, sigma) + ROUNDING * np.eye(len(sigma))
        self._information = inverse(factored(correlation)) / np.outer(sigma, sigma)

    @property
    def sizes(self) -> Mapping[int, int]:
        """Components of each variable, in order."""
        return self._known.sizes

    def cost(self, values: gtsam.Values) -> float:
        """Return half the squared distance from the mean."""
        away = local(self._known.values, values, self.sizes)
        return float(0.5 * away @ (self._information @ away))

    def quadratic(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
        """Return the cost's second derivative and gradient by perturbations of values."""
        away = local(self._known.values, values, self.sizes)
        H, g = self._information.copy(), self._information @ away
        for own in poses_among(self.sizes):
            by_now = gtsam.Pose3.LogmapDerivative(away[own])
            H[own], g[own] = by_now.T @ H[own], by_now.T @ g[own]
            H[:, own] = H[:, own] @ by_now
        return H, g


@dataclass(frozen=True)
class Descent:
    """Where a descent came to.

    Attributes
    ----------
    values
        Of all variables.
    sizes
        Components of each, in order.
    lower
        Cholesky factor of the information about them, in this order, shape (n, n).
    steps
        That were taken.
    """

    values: gtsam.Values
    sizes: Mapping[int, int]
    lower: FloatArray
    steps: int

    def last(self, count: int) -> JointGaussian:
        """Return what is known of the last variables, so many of them."""
        keys = list(self.sizes)[len(self.sizes) - count :]
        sizes = {key: self.sizes[key] for key in keys}
        start = len(self.lower) - sum(sizes.values())
        return JointGaussian(
            part_of(self.values, keys), sizes, inverse(self.lower[start:, start:])
        )


def descended(
    graph: gtsam.NonlinearFactorGraph,
    prior: Prior,
    values: gtsam.Values,
    sizes: Mapping[int, int],
    most: int,
) -> Descent:
    """Minimise the cost of a graph and a prior, by Newton's method as Gauss has it.

    A step that does not lessen the cost is damped.

    Parameters
    ----------
    graph
        Factors.
    prior
        Of some of the variables.
    values
        Where to start.
    sizes
        Components of all variables, in the order that they are solved for.
    most
        Steps.

    Raises
    ------
    CalibrationError
        The covariances of what is known are too many orders of magnitude apart.
    """
    cost = graph.error(values) + prior.cost(values)
    for step in range(1, most + 1):
        H, g = gathered(graph, prior, values, sizes)
        lower = factored(H)
        newton = cho_solve((lower, True), g, check_finite=False)
        length = float(g @ newton)
        for damping in DAMPINGS:
            if damping:
                damped = factored(H + damping * np.diag(np.diag(H)))
                newton = cho_solve((damped, True), g, check_finite=False)
            there = retracted(values, sizes, -newton)
            reached = graph.error(there) + prior.cost(there)
            if reached <= cost * (1 + RISE):
                values, cost = there, reached
                break
        else:
            break
        if length < CLOSE:
            break
    return Descent(values, sizes, lower, step)


def gathered(
    graph: gtsam.NonlinearFactorGraph,
    prior: Prior,
    values: gtsam.Values,
    sizes: Mapping[int, int],
) -> tuple[FloatArray, FloatArray]:
    """Return the second derivative of the cost, as Gauss has it, and its gradient."""
    slices = slices_of(sizes)
    count = sum(sizes.values())
    H, g = np.zeros((count, count)), np.zeros(count)
    at = columns_of(slices, prior.sizes)
    information, gradient = prior.quadratic(values)
    H[np.ix_(at, at)] = information
    g[at] = gradient
    linear = graph.linearize(values)
    for part in by_tile([linear.at(i) for i in range(linear.size())]):
        keys = list(dict.fromkeys(key for factor in part for key in factor.keys()))
        own, at = slices_of({key: sizes[key] for key in keys}), columns_of(slices, keys)
        blocks = [factor.jacobian() for factor in part]
        ends = np.cumsum([0, *(len(rhs) for _, rhs in blocks)])
        J = np.zeros((ends[-1], len(at)))
        for factor, start, end, (A, _) in zip(part, ends[:-1], ends[1:], blocks, strict=True):
            J[start:end, columns_of(own, factor.keys())] = A
        H[np.ix_(at, at)] += J.T @ J
        g[at] -= J.T @ np.concatenate([rhs for _, rhs in blocks])
    return H, g


def by_tile(factors: list[gtsam.JacobianFactor]) -> list[list[gtsam.JacobianFactor]]:
    """Return factors with those together that have weights of one tile."""
    groups: dict[int, list[gtsam.JacobianFactor]] = {}
    for number, factor in enumerate(factors):
        tiles = [key for key in factor.keys() if gtsam.symbolChr(key) == ord("M")]
        groups.setdefault(tiles[0] if tiles else -1 - number, []).append(factor)
    return list(groups.values())


def factored(information: FloatArray) -> FloatArray:
    """Return the Cholesky factor.

    Raises
    ------
    CalibrationError
        There is none.
    """
    try:
        return np.asarray(cholesky(information, lower=True, check_finite=False))
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "what is known of poses and field cannot be computed: covariances of odometry, start "
            "and readings are too many orders of magnitude apart"
        ) from error


def inverse(lower: FloatArray) -> FloatArray:
    """Return ``(L L^T)^-1``."""
    half, _ = dpotri(lower, lower=1)
    return np.asarray(np.tril(half) + np.tril(half, -1).T)

