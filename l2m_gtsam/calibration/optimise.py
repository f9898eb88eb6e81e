"""GTSAM's optimisers and how they ended; its marginals, and QR where these are refused."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from l2m_factors import T
from l2m_gtsam.calibration.sensor_columns import PLACES, columns_among, columns_of, keys_of
from l2m_gtsam.data import FloatArray
from l2m_gtsam.solve.linear_algebra import parts_of

# Smallest decrease of the error that counts, relative and absolute (GTSAM's own). A descent only
# has to come near: polishing ends it, and what remains is judged in standard deviations.
TOLERANCE = 1e-5
NEARLY = 0.1  # the same where other steps, or a round with other weights, go on from its end
# Relative rise of the error that the seams of a map explain: measured 3e-5.
SEAM_RISE = 1e-3


class Optimizer(StrEnum):
    """A nonlinear least-squares method."""

    LM = "lm"
    GN = "gn"


class LinearSolver(StrEnum):
    """How each linear system is solved.

    GTSAM's Cholesky gives up on a clique whose last pivot is 4,000 times smaller than the one
    before; QR does not mind, and takes a few times as long where cliques are large.
    """

    QR = "MULTIFRONTAL_QR"
    CHOLESKY = "MULTIFRONTAL_CHOLESKY"


class Ending(StrEnum):
    """How an optimisation ended."""

    TOLERANCE = "the error no longer falls"
    ITERATION_LIMIT = "the iteration limit was reached"
    SINGULAR = "the linear system is singular"
    UPHILL = "a step would have raised the error"


@dataclass(frozen=True)
class Optimised:
    """Where an optimisation arrived.

    Attributes
    ----------
    values
        Optimised values; the start if the system was singular, or a step went uphill.
    ending
        Why it stopped.
    """

    values: gtsam.Values
    ending: Ending


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    optimizer: Optimizer,
    max_iterations: int,
    solver: LinearSolver = LinearSolver.QR,
    tolerance: float = TOLERANCE,
) -> Optimised:
    """Minimise a graph's error from a start, with at most so many linearisations.

    It ends where the error falls by less than the tolerance, relative or absolute.
    """
    engine = _engine(graph, start, optimizer, max_iterations, solver, tolerance)
    try:
        values = engine.optimize()
    except RuntimeError as error:
        if not refused(error):
            raise
        return Optimised(start, Ending.SINGULAR)
    spent = engine.iterations() >= max_iterations
    return Optimised(values, Ending.ITERATION_LIMIT if spent else Ending.TOLERANCE)


def polish(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    steps: int,
    solver: LinearSolver = LinearSolver.QR,
) -> Optimised:
    """Take Gauss-Newton steps to where the gradient vanishes, whatever the error does.

    A map of blocks leaves small steps in the error where readings cross from block to block. A
    descent stops at them, a third of a standard deviation early in the simulated warehouse; the
    gradient does not see them. A rise of the error beyond what such steps make is refused.
    """
    engine = _engine(graph, values, Optimizer.GN, steps, solver, TOLERANCE)
    worst = most_after_step(engine.error())
    try:
        for _ in range(steps):
            engine.iterate()
    except RuntimeError as error:
        if not refused(error):
            raise
        return Optimised(values, Ending.SINGULAR)
    if engine.error() > worst:  # which the engine knows: readings are not asked again
        return Optimised(values, Ending.UPHILL)
    return Optimised(engine.values(), Ending.TOLERANCE)


def most_after_step(error: float) -> float:
    """Return the most that an error may be after a step that is not refused."""
    return (1 + SEAM_RISE) * error + SEAM_RISE


def refused(error: Exception) -> bool:
    """Return whether GTSAM calls a linear system indeterminate, or what it says as exact.

    Its IndeterminantLinearSystemException has no type in Python.
    """
    return any(words in str(error) for words in ("ndetermina", "constrained noise model"))


def _engine(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    optimizer: Optimizer,
    max_iterations: int,
    solver: LinearSolver,
    tolerance: float,
) -> gtsam.NonlinearOptimizer:
    if optimizer is Optimizer.GN:
        gauss_newton = gtsam.GaussNewtonParams()
        _limit(gauss_newton, max_iterations, solver, tolerance)
        return gtsam.GaussNewtonOptimizer(graph, start, gauss_newton)
    levenberg = gtsam.LevenbergMarquardtParams()
    _limit(levenberg, max_iterations, solver, tolerance)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, levenberg)


def _limit(
    params: gtsam.NonlinearOptimizerParams,
    max_iterations: int,
    solver: LinearSolver,
    tolerance: float,
) -> None:
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(tolerance)
    params.setAbsoluteErrorTol(tolerance)
    params.setLinearSolverType(solver.value)


JointCovariance = Callable[[tuple[int, ...]], FloatArray]
"""Of all parameters of some sensors, in order, shape (16 n, 16 n)."""


def joint_covariance(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, instead: JointCovariance
) -> JointCovariance:
    """Return the marginal covariances of the sensors of a linear graph.

    All else is eliminated once, and the marginals are those of what is left: a joint covariance of
    36 of 190 variables asked of the whole graph's tree took four times as long.

    GTSAM's marginals are made by Cholesky. They call a system indeterminate where a direction is
    4,000 times better known than its neighbour, though it is not.

    Parameters
    ----------
    linear, values
        The graph, and where it was linearised.
    instead
        What gives them where GTSAM refuses.
    """
    own = [key for sensor in sensors_in(linear) for key in keys_of(sensor)]
    try:
        marginals = gtsam.Marginals(linear.marginal(own), values)
    except RuntimeError as error:
        if not refused(error):
            raise
        return instead

    def among(sensors: tuple[int, ...]) -> FloatArray:
        keys = [key for sensor in sensors for key in keys_of(sensor)]
        try:
            joint = marginals.jointMarginalCovariance(keys)
        except RuntimeError as error:
            if not refused(error):
                raise
            return instead(sensors)
        return np.asarray(np.block([[joint.at(a, b) for b in keys] for a in keys]))

    return among


def covariance_by_qr(linear: gtsam.GaussianFactorGraph, sensors: tuple[int, ...]) -> FloatArray:
    """Return the marginal covariance of sensors that factors connect, by QR, (16 n, 16 n)."""
    cluster = next(each for each in clusters_of(linear, sensors_in(linear)) if sensors[0] in each)
    ordering = gtsam.Ordering()
    for key in columns_of(cluster):
        ordering.push_back(key)
    own = gtsam.GaussianFactorGraph()
    for index in range(linear.size()):
        if set(linear.at(index).keys()) <= set(columns_of(cluster)):
            own.push_back(linear.at(index))
    jacobian, _ = own.jacobian(ordering)
    scale = 1 / np.linalg.norm(jacobian, axis=0)
    triangular = np.asarray(np.linalg.qr(jacobian * scale, mode="r"))
    root = scale[:, None] * solve_triangular(triangular, np.eye(len(scale)))
    at = columns_among(cluster, sensors)
    return np.asarray(root[at] @ root[at].T)


def clusters_of(linear: gtsam.GaussianFactorGraph, sensors: list[int]) -> list[tuple[int, ...]]:
    """Return the sensors in groups that no factor connects; each by itself where none do."""
    owner = {key(sensor): row for row, sensor in enumerate(sensors) for key in PLACES}
    pairs = [(0, 0)]
    for index in range(linear.size()):
        rows = sorted({owner[key] for key in list(linear.at(index).keys()) if key in owner})
        pairs += [(rows[0], row) for row in rows[1:]]
    labels, named = parts_of(np.array(pairs), len(sensors)), np.array(sensors)
    return [tuple(named[labels == label].tolist()) for label in range(labels.max() + 1)]


def sensors_in(linear: gtsam.GaussianFactorGraph) -> list[int]:
    """Return the sensors whose positions are variables of a graph."""
    keys = {key for index in range(linear.size()) for key in list(linear.at(index).keys())}
    symbols = (gtsam.Symbol(key) for key in keys)
    return sorted(int(each.index()) for each in symbols if each.key() == T(each.index()))
