"""Run a GTSAM optimiser and say how it ended."""

from dataclasses import dataclass
from enum import StrEnum

import gtsam

# Smallest decrease of the error that counts, relative and absolute (GTSAM's own). A descent only
# has to come near: polishing ends it, and what remains is judged in standard deviations.
TOLERANCE = 1e-5
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


@dataclass(frozen=True)
class Optimised:
    """Where an optimisation arrived.

    Attributes
    ----------
    values
        Optimised values; the start if the system was singular.
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
) -> Optimised:
    """Minimise a graph's error from a start, with at most so many linearisations."""
    engine = _engine(graph, start, optimizer, max_iterations, solver)
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
    """Take Gauss-Newton steps to where the gradient vanishes, without asking the error.

    A map of blocks leaves small steps in the error where readings cross from block to block. A
    descent stops at them, a third of a standard deviation early in the simulated warehouse; the
    gradient does not see them. A rise of the error beyond what such steps make is refused.
    """
    params = gtsam.GaussNewtonParams()
    _limit(params, steps, solver)
    engine = gtsam.GaussNewtonOptimizer(graph, values, params)
    worst = (1 + SEAM_RISE) * engine.error() + SEAM_RISE
    try:
        for _ in range(steps):
            engine.iterate()
    except RuntimeError as error:
        if not refused(error):
            raise
        return Optimised(values, Ending.SINGULAR)
    good = engine.error() <= worst
    return Optimised(engine.values() if good else values, Ending.TOLERANCE)


def refused(error: RuntimeError) -> bool:
    """Return whether GTSAM calls a linear system indeterminate.

    Its IndeterminantLinearSystemException has no type in Python.
    """
    return "ndetermina" in str(error)


def _engine(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    optimizer: Optimizer,
    max_iterations: int,
    solver: LinearSolver,
) -> gtsam.NonlinearOptimizer:
    if optimizer is Optimizer.GN:
        gauss_newton = gtsam.GaussNewtonParams()
        _limit(gauss_newton, max_iterations, solver)
        return gtsam.GaussNewtonOptimizer(graph, start, gauss_newton)
    levenberg = gtsam.LevenbergMarquardtParams()
    _limit(levenberg, max_iterations, solver)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, levenberg)


def _limit(
    params: gtsam.NonlinearOptimizerParams,
    max_iterations: int,
    solver: LinearSolver,
) -> None:
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(TOLERANCE)
    params.setAbsoluteErrorTol(TOLERANCE)
    params.setLinearSolverType(solver.value)
