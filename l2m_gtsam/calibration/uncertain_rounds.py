"""Rounds of the graph with shared errors, until its weights are those of its result.

What makes readings white follows C and the noise of the sensors, which the graph determines.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint_information import JointInformation
from l2m_gtsam.calibration.optimise import Ending, LinearSolver
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.calibration.uncertain_graph import (
    ROUND_SIGMAS,
    THERE_SIGMAS,
    UncertainDrive,
    UncertainProblem,
    starting_values,
)
from l2m_gtsam.calibration.uncertain_optimum import UncertainOptimum
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.rank import Determinacy, RankOptions

MAX_ROUNDS = 10
# Where places are open errors of the map stand in for them, and steps overshoot.
ROUNDS_OF_OPEN = 20
SETTLED_SIGMAS = 0.1  # what such a step is at most in the last round


@dataclass(frozen=True)
class Beginning:
    """Where the rounds of the graph begin.

    Attributes
    ----------
    values
        All variables.
    near
        Whether the optimum is so near that no descent is needed.
    readings
        Those of the drive where their poses are likely, if that is known.
    """

    values: gtsam.Values
    near: bool
    readings: Readings | None = None


@dataclass(frozen=True)
class Settled:
    """Where the rounds ended.

    Attributes
    ----------
    optimum
        That of the graph of the last round.
    estimate
        All sensors there, with their noise.
    ending
        How the last optimisation ended.
    unsettled
        Sensors whose estimate or weights another round would change.
    """

    optimum: UncertainOptimum
    estimate: Estimate
    ending: Ending
    unsettled: frozenset[int]

    @property
    def drive(self) -> UncertainDrive:
        """Readings and what they share."""
        return self.optimum.problem.drive


def settle_by_any(
    drive: UncertainDrive,
    near: Estimate,
    progress: Callable[[float], None],
    begin: Beginning | None = None,
) -> Settled:
    """Solve by Cholesky, and where that is refused by QR; from no shared error if not elsewhere."""
    if begin is None:
        zero = starting_values(near, drive.view.sensors, drive.coverage)
        begin = Beginning(zero, near=False)
    for solver in (LinearSolver.CHOLESKY, LinearSolver.QR):
        found = settle(drive, near, begin, solver, progress)
        if found.ending is not Ending.SINGULAR:
            break
    return found


def settle(
    drive: UncertainDrive,
    estimate: Estimate,
    begin: Beginning,
    solver: LinearSolver,
    progress: Callable[[float], None],
) -> Settled:
    """Solve the graph again and again, until the weights are those of its result.

    Parameters
    ----------
    drive
        Readings and what they share.
    estimate, begin
        Where to start.
    solver
        Of the linear systems.
    progress
        Called with the fraction that is done.
    """
    sensors, options = drive.view.sensors, drive.options
    unsettled = frozenset(sensors)
    values, near, readings = begin.values, begin.near, begin.readings
    ending, begun = Ending.TOLERANCE, estimate
    open_ = [s for s in sensors if drive.tests[s].place_open]
    for round_ in range(most := ROUNDS_OF_OPEN if open_ else MAX_ROUNDS):
        held_at = estimate.as_in(begun, open_)  # else they slide on with each round
        problem = UncertainProblem(drive, estimate, held_at, readings)
        arrived = problem.arrive(values, solver, near=near)
        values, joint = arrived.values, arrived.joint
        optimum = UncertainOptimum(problem, values, joint)
        if arrived.ending is Ending.SINGULAR:
            return Settled(optimum, estimate, arrived.ending, frozenset(sensors))
        if not near:  # then it was a descent
            ending = arrived.ending
        near = joint.furthest(sensors) < ROUND_SIGMAS
        after = estimate.updated(values, sensors)
        if options.sensor_noise_ut is None:
            after = replace(after, noise=optimum.noise())
        # The first weights are those of the optimum with independent errors, if none is predicted.
        if round_ > 0 or begin.near:
            unsettled = still_changing(problem, joint, after, estimate, options.rank)
        estimate = after
        if not unsettled:
            break
        readings = problem.at_likely_poses(values)
        progress((round_ + 2) / (most + 1))
    return Settled(optimum, estimate, ending, unsettled)


def still_changing(
    problem: UncertainProblem,
    joint: JointInformation,
    after: Estimate,
    before: Estimate,
    options: RankOptions,
) -> frozenset[int]:
    """Return the sensors that another round would change: all if it is what they share.

    One whose place is open may go wherever it likes along what its readings do not determine.

    Parameters
    ----------
    problem
        The round.
    joint
        All variables together, a step before the end of it.
    after, before
        Sensors with their noise at its end and in its weights.
    options
        The scales of the rank test.
    """
    sensors = problem.drive.view.sensors
    changing = frozenset(
        s
        for s in sensors
        if joint.sigmas(s, determined_rows(problem.drive.tests[s], options)) >= SETTLED_SIGMAS
        or not problem.same_noise(after, before, s)
    )
    return changing or frozenset(sensors if joint.decrement >= THERE_SIGMAS else ())


def determined_rows(test: Determinacy, options: RankOptions) -> FloatArray | None:
    """Return what is determined of a sensor whose place is open: rows over its parameters, (K, 16).

    None for others, of which all is looked at.
    """
    if not test.place_open:
        return None
    known = test.determined / options.scale()
    rows = np.zeros((len(known) + 1, SENSOR))
    rows[:-1, :-1], rows[-1, -1] = known, 1.0
    return rows
