"""GTSAM's solvers for the graphs of SLAM, chosen by measurement.

Processor seconds of one elimination, one thread; in brackets how many components:

=================================  ==================  ==================  ====================
graph                              COLAMD              weights first       METIS
                                   Cholesky, QR        Cholesky, QR        Cholesky, QR
=================================  ==================  ==================  ====================
map, fixed (2,771)                 0.014, 0.080        0.66, 9.0           0.015, 0.080
map, refined (2,490)               0.019, 0.108        0.019, 0.11         0.020, 0.082
no map, fixed (2,460; 12 tiles)    0.026, 0.36         0.041, 0.42         0.017, 0.11
no map, refined (2,190; 12 tiles)  0.21, 8.1           0.037, 0.19         0.032, 0.14
=================================  ==================  ==================  ====================

In a map the errors of all tiles have one prior, so that eliminating them first connects all poses.
Without one a tile's weights connect no more than the poses in it; COLAMD, which counts variables
and not their sizes, leaves them to the end where calibrations are on all factors. METIS ended the
process with a segmentation fault in a section of 27 variables (GTSAM 4.3.0).
"""

from collections.abc import Generator, Iterator

import gtsam

from l2m_factors import M, X
from l2m_gtsam.calibration.optimise import (
    TOLERANCE,
    Ending,
    LinearSolver,
    Optimised,
    most_after_step,
)
from l2m_gtsam.progress import completed
from l2m_gtsam.slam.marginals import Marginals, unless_indeterminate

LAST = (ord("T"), ord("D"), ord("V"))
# Of the first step, and the least: it changes steps, not the minimum. From 1e-10, where GTSAM comes
# after some good steps, seven are tried before the next good one: a sixth of the time on the ship.
DAMPING = 1e-3


def gauss_newton(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    ordering: gtsam.Ordering,
    max_iterations: int,
) -> Optimised:
    """Minimise a graph's error in a map by Gauss-Newton; by Levenberg-Marquardt where that fails.

    At the seams of a map the error rises a little though the gradient says that it falls.
    Levenberg-Marquardt would try ever shorter steps there: ten eliminations for each step, and 20
    of 24 in a drive of two minutes.

    Parameters
    ----------
    graph, start, ordering, max_iterations
        As of ``levenberg_marquardt``.
    """
    params = gtsam.GaussNewtonParams()
    params.setOrdering(ordering)
    params.setLinearSolverType(LinearSolver.CHOLESKY.value)
    engine = gtsam.GaussNewtonOptimizer(graph, start, params)
    for _ in range(max_iterations):
        # A copy: the engine's own values are gone with the next step.
        before, error = gtsam.Values(engine.values()), engine.error()
        step = unless_indeterminate(engine.iterate)
        if step is None or not engine.error() <= most_after_step(error):
            left = max_iterations - engine.iterations()
            return levenberg_marquardt(graph, before, ordering, left)
        if error - engine.error() <= TOLERANCE * max(error, 1.0):
            return Optimised(engine.values(), Ending.TOLERANCE)
    return Optimised(engine.values(), Ending.ITERATION_LIMIT)


def levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    ordering: gtsam.Ordering,
    max_iterations: int,
    close: float = TOLERANCE,
) -> Optimised:
    """Minimise a graph's error by Levenberg-Marquardt.

    Where Cholesky fails on a linear system GTSAM's optimiser silently increases the damping, as if
    the step had increased the error, and small steps then end the descent. So where the damping has
    grown in the end the descent goes on with that of the start: by Cholesky if that solves the
    system without damping, and by QR, at ten times the cost, if not.

    Parameters
    ----------
    graph, start
        Factors and initial values.
    ordering
        Elimination order of the variables.
    max_iterations
        Limit of linearisations.
    close
        Decrease of the error below which it has converged.
    """
    return completed(stepwise_levenberg_marquardt(graph, start, ordering, max_iterations, close))


def stepwise_levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    ordering: gtsam.Ordering,
    max_iterations: int,
    close: float = TOLERANCE,
) -> Generator[None, None, Optimised]:
    """Minimise a graph's error by Levenberg-Marquardt, one iteration after the other.

    Yields before each iteration. Parameters and result are those of ``levenberg_marquardt``.
    """
    first = _optimizer(graph, start, ordering, max_iterations, close, LinearSolver.CHOLESKY)
    before = first.lambda_()
    yield from _iterations(first, max_iterations, close)
    values, left = first.values(), max_iterations - first.iterations()
    if first.lambda_() > before and left > 0:
        second = _optimizer(graph, values, ordering, left, close, _solver(graph, values, ordering))
        yield from _iterations(second, left, close)
        values, left = second.values(), left - second.iterations()
    return Optimised(values, Ending.TOLERANCE if left > 0 else Ending.ITERATION_LIMIT)


def _iterations(
    engine: gtsam.LevenbergMarquardtOptimizer, max_iterations: int, close: float
) -> Iterator[None]:
    """Iterate to convergence as GTSAM's own loop does; yield before each iteration."""
    error, converged = engine.error(), False
    while not converged and engine.iterations() < max_iterations:
        yield
        engine.iterate()
        decrease, error = error - engine.error(), engine.error()
        # An error that is not a number ends it, too.
        converged = not decrease > max(close, TOLERANCE * (error + decrease))


def _solver(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering
) -> LinearSolver:
    """Return Cholesky where it solves a graph's linear system, QR where it does not."""
    step = unless_indeterminate(lambda: graph.linearize(values).optimize(ordering))
    return LinearSolver.QR if step is None else LinearSolver.CHOLESKY


def colamd_ordering(graph: gtsam.NonlinearFactorGraph) -> gtsam.Ordering:
    """Return the minimum-degree ordering."""
    return gtsam.Ordering.ColamdNonlinearFactorGraph(graph)


def marginals_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Marginals:
    """Return the covariances of a graph at its solution."""
    return Marginals(graph.linearize(values), colamd_ordering(graph))


def weights_first(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Ordering:
    """Return the minimum-degree ordering that eliminates tiles' weights first."""
    weights = [key for key in values.keys() if gtsam.symbolChr(key) == ord("M")]  # noqa: SIM118
    return gtsam.Ordering.ColamdConstrainedFirstNonlinearFactorGraph(graph, weights, False)


def weights_last(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Ordering:
    """Return the minimum-degree ordering that eliminates a single tile's weights last.

    They and their anchor are on all factors: eliminated first they would connect all poses.
    """
    keys = list(values.keys())
    sensors = [key for key in keys if gtsam.symbolChr(key) in LAST]
    last = [*sensors, X(0), M(0)]
    return gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, last, True)


def _optimizer(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    ordering: gtsam.Ordering,
    max_iterations: int,
    close: float,
    solver: LinearSolver,
) -> gtsam.LevenbergMarquardtOptimizer:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(max_iterations)
    params.setAbsoluteErrorTol(close)
    params.setRelativeErrorTol(TOLERANCE)
    params.setlambdaInitial(DAMPING)
    params.setlambdaLowerBound(DAMPING)
    params.setOrdering(ordering)
    params.setLinearSolverType(solver.value)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, params)
