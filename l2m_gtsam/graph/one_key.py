"""The one-key solve: from readings and a map to t, C, H and their uncertainty.

The paper's algorithm 1 in two stages. The *alternation* brings t near: the distortion follows in
closed form from what the map predicts at the current t (w-RRTLS), then the graph over all ``T(i)``
moves the sensors, with the same weights inside and outside. The *joint* graph over ``T(i)`` and
``D(i)`` then finishes both, with the full covariance of each reading, and its marginals are the
uncertainty. All sensors are in one graph and share one evaluation of the map.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, Readings, Uncertainty
from l2m_gtsam.graph.alternation import (
    OneKeyOptions,
    Progress,
    alternate,
    start_estimate,
)
from l2m_gtsam.graph.calibration import Estimate
from l2m_gtsam.graph.joint import SensorSolution, joint_problem, joint_step, sensor_solutions
from l2m_gtsam.graph.optimise import Ending
from l2m_gtsam.graph.uncertain import UncertainMap, solve_uncertain
from l2m_gtsam.graph.view import QueryableMap, observe

# The joint graph is solved again while its frozen weights still change; they settle in two or
# three rounds, and a set of readings that keeps hopping over the map's edge is cut off here.
MAX_ROUNDS = 10
SETTLED_M = 1e-5
# The map's variance changes over decimetres: after a shorter move it is not asked for again.
REOBSERVE_M = 5e-3


@dataclass(frozen=True)
class OneKeySolution:
    """The estimate of all sensors and, for those that could be solved, how good it is.

    Attributes
    ----------
    estimate
        Values of all S sensors; what stands for one that is not solved means nothing.
    solved
        Solutions of the sensors that have enough readings inside the map.
    inside
        Which readings lie inside the map at the estimate, shape (N,).
    steps
        Alternations taken.
    ending
        How the last joint optimisation ended.
    settled
        Whether estimate and weights agree: another round would repeat the last.
    uncertainty
        How the map's errors were counted: full needs a map that knows them.
    """

    estimate: Estimate
    solved: tuple[SensorSolution, ...]
    inside: BoolArray
    steps: int
    ending: Ending
    settled: bool
    uncertainty: Uncertainty = Uncertainty.INDEPENDENT


def solve_one_key(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    options: OneKeyOptions,
    progress: Progress | None = None,
) -> OneKeySolution:
    """Calibrate all sensors of a batch of readings.

    Parameters
    ----------
    readings
        Readings of S sensors with poses.
    field_map
        The magnetic map.
    t_start
        Where to start each sensor in the lidar frame in metres, shape (S, 3).
    options
        How to solve.
    progress
        Called with a stage and the fraction of it that is done.
    """
    tell = progress or (lambda stage, fraction: None)
    near = alternate(readings, field_map, start_estimate(t_start, options), options, tell)
    estimate, ending, settled = near.estimate, Ending.TOLERANCE, False
    view = observe(readings, field_map, estimate, options.min_readings)
    if not view.sensors:
        return OneKeySolution(estimate, (), view.inside, near.steps, ending, settled)
    for round_ in range(MAX_ROUNDS):
        tell("joint graph", round_ / MAX_ROUNDS)
        problem = joint_problem(view, field_map, estimate, options)
        step = joint_step(problem, estimate, options)
        moved = float(np.abs(step.estimate.t - estimate.t).max())
        settled = moved < SETTLED_M and step.estimate.same_noise(estimate)
        estimate, ending = step.estimate, step.ending
        if settled:
            break
        if moved > REOBSERVE_M:
            view = observe(readings, field_map, estimate, options.min_readings)
    tell("joint graph", 1.0)
    if not settled:  # the weights of the last round are not those of its result
        problem = joint_problem(view, field_map, estimate, options)
    full_asked = options.uncertainty is Uncertainty.FULL and bool(view.sensors)
    if full_asked and isinstance(field_map, UncertainMap):
        tell("map uncertainty", 0.0)
        full = solve_uncertain(view, field_map, field_map, estimate, problem.determinacies, options)
        tell("map uncertainty", 1.0)
        return OneKeySolution(
            estimate=full.estimate,
            solved=full.solved,
            inside=view.inside,
            steps=near.steps,
            ending=ending,
            settled=settled and full.settled,
            uncertainty=Uncertainty.FULL,
        )
    solved = sensor_solutions(problem, estimate)
    return OneKeySolution(estimate, solved, view.inside, near.steps, ending, settled)
