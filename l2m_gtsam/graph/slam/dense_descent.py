"""Least squares over some hundred variables that a dense Gaussian prior ties together.

GTSAM's optimisers eliminate variable by variable, which is slow where all of them hang together.
Here its factors are linearised and gathered in one dense system, that of one tile's readings at
a time, beside the prior's information, which is the same in each iteration.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import cho_solve, cholesky
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
DAMPINGS = (1e-4, 1e-2, 1.0, 100.0)  # of a step, in units of the diagonal, one after the other
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
    """

    values: gtsam.Values
    sizes: Mapping[int, int]
    lower: FloatArray

    def last(self, count: int) -> JointGaussian:
        """Return what is known of the last variables, so many of them."""
        keys = list(self.sizes)[len(self.sizes) - count :]
        sizes = {key: self.sizes[key] for key in keys}
        start = len(self.lower) - sum(sizes.values())
        return JointGaussian(part_of(self.values, keys), sizes, inverse(self.lower[start:, start:]))


def descended(
    graph: gtsam.NonlinearFactorGraph,
    prior: Prior,
    values: gtsam.Values,
    sizes: Mapping[int, int],
    most: int,
) -> Descent:
    """Minimise the cost of a graph and a prior, by Newton's method as Gauss has it.

    A step that does not lessen the cost is damped. The information is that where the last step
    began, which was short.

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
    for _ in range(most):
        H, g = gathered(graph, prior, values, sizes)
        lower = factored(H)
        newton = cho_solve((lower, True), g, check_finite=False)
        there = lessened(graph, prior, values, sizes, Quadratic(H, g, newton))
        values = values if there is None else there
        if there is None or float(g @ newton) < CLOSE:
            break
    return Descent(values, sizes, lower)


@dataclass(frozen=True)
class Quadratic:
    """The cost about some values: second derivative, gradient, and the step to its least value."""

    H: FloatArray
    g: FloatArray
    newton: FloatArray


def lessened(
    graph: gtsam.NonlinearFactorGraph,
    prior: Prior,
    values: gtsam.Values,
    sizes: Mapping[int, int],
    near: Quadratic,
) -> gtsam.Values | None:
    """Return values that cost less, by the longest step that does so; none if no step does."""
    most = (graph.error(values) + prior.cost(values)) * (1 + RISE)
    there = retracted(values, sizes, -near.newton)
    if graph.error(there) + prior.cost(there) <= most:
        return there
    for damping in DAMPINGS:
        lower = factored(near.H + damping * np.diag(np.diag(near.H)))
        there = retracted(values, sizes, -cho_solve((lower, True), near.g, check_finite=False))
        if graph.error(there) + prior.cost(there) <= most:
            return there
    return None


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
    for part in by_tile(graph.linearize(values)):
        keys = list(dict.fromkeys(key for factor in part for key in factor.keys))
        own, at = slices_of({key: sizes[key] for key in keys}), columns_of(slices, keys)
        ends = np.cumsum([0, *(len(factor.b) for factor in part)])
        J, b = np.zeros((ends[-1], len(at))), np.concatenate([factor.b for factor in part])
        for factor, start, end in zip(part, ends[:-1], ends[1:], strict=True):
            J[start:end, columns_of(own, factor.keys)] = factor.A
        H[np.ix_(at, at)] += J.T @ J
        g[at] -= J.T @ b
    return H, g


@dataclass(frozen=True)
class LinearFactor:
    """A linearised factor: ``|A x - b|^2 / 2`` in the variables of these keys, one by one."""

    keys: list[int]
    A: FloatArray
    b: FloatArray


def by_tile(linear: gtsam.GaussianFactorGraph) -> list[list[LinearFactor]]:
    """Return factors with those together that have weights of one tile."""
    groups: dict[int, list[LinearFactor]] = {}
    for number in range(linear.size()):
        factor = linear.at(number)
        keys = list(factor.keys())
        tiles = [key for key in keys if gtsam.symbolChr(key) == ord("M")]
        group = groups.setdefault(tiles[0] if tiles else -1 - number, [])
        group.append(LinearFactor(keys, *factor.jacobian()))
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
