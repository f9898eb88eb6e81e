"""How GTSAM solves the graphs of SLAM: solver and ordering, chosen by measurement.

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

In a map the errors of all tiles have one prior, so that eliminating them first ties all poses
together. Without one a tile's weights tie no more than the poses in it; COLAMD, which counts
variables and not their sizes, leaves them to the end where calibrations are on all factors. METIS
ended the process with a segmentation fault in a section of 27 variables (GTSAM 4.3.0).
"""

import gtsam

from l2m_gtsam.calibration.optimise import TOLERANCE, Ending, LinearSolver, Optimised


def descended(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    ordering: gtsam.Ordering,
    max_iterations: int,
    close: float = TOLERANCE,
) -> Optimised:
    """Minimise a graph's error by Levenberg-Marquardt, with at most so many linearisations.

    A linear system that GTSAM's Cholesky refuses is damped by its optimiser as if the step had led
    astray, without a word. So where there is more damping in the end than there was, QR goes on.

    Parameters
    ----------
    graph, start
        Factors, and where to start.
    ordering
        In which variables are eliminated.
    max_iterations
        The most linearisations.
    close
        Decrease of the error that does not count any more.
    """
    first = _engine(graph, start, ordering, max_iterations, close, LinearSolver.CHOLESKY)
    before, values = first.lambda_(), first.optimize()
    left = max_iterations - first.iterations()
    if first.lambda_() > before and left > 0:
        second = _engine(graph, values, ordering, left, close, LinearSolver.QR)
        values = second.optimize()
        left -= second.iterations()
    return Optimised(values, Ending.TOLERANCE if left > 0 else Ending.ITERATION_LIMIT)


def least_fill(graph: gtsam.NonlinearFactorGraph) -> gtsam.Ordering:
    """Return the order by minimum degree."""
    return gtsam.Ordering.ColamdNonlinearFactorGraph(graph)


def weights_first(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Ordering:
    """Return the order by minimum degree in which tiles' weights go first."""
    weights = [key for key in values.keys() if gtsam.symbolChr(key) == ord("M")]  # noqa: SIM118
    return gtsam.Ordering.ColamdConstrainedFirstNonlinearFactorGraph(graph, weights, False)


def _engine(
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
    params.setOrdering(ordering)
    params.setLinearSolverType(solver.value)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, params)
