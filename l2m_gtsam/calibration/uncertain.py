"""The joint graph over an uncertain map: ``T(i)``, ``D(i)``, ``S(i)``, and errors that are shared.

The map's errors, ``M(b)``, are shared by readings near each other, in one pass or in many, of one
sensor or of all; those of the lidar's poses, ``P(k)``, by readings near each other in time; fields
that recorded numbers add, ``Q(i)``, by all readings of a sensor. As variables of the graph they
carry that into the marginals; counted as noise of each reading they would average out as they do
not in truth.

GTSAM descends and gives the covariances, by Cholesky in COLAMD's ordering. The weights hang
together through the map's prior in one clique whatever the ordering is: for 2,471 of them a linear
solve took 0.54 s of a processor so, 0.70 s with sensors last, 0.76 s and more with sensors first.
METIS was as fast, but GTSAM 4.3 can crash in it. QR is for graphs that Cholesky refuses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.budget.found import NOTHING_FOUND, Budget
from l2m_gtsam.calibration.budget.processes import ReadingPlaces
from l2m_gtsam.calibration.budget.search import NOTHING_SEARCHED, FoundProcess, Searched, search
from l2m_gtsam.calibration.budget.unseen_warp import unseen_warp
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint import SensorSolution
from l2m_gtsam.calibration.optimise import Ending, LinearSolver, Optimised
from l2m_gtsam.calibration.parts_alone import ByParts
from l2m_gtsam.calibration.stated_sizes import (
    beside_processes,
    leave_noise,
    noise_is_short,
    poses_too_small,
    shown_by_one,
)
from l2m_gtsam.calibration.uncertain_graph import (
    IndependentOptimum,
    UncertainDrive,
    UncertainProblem,
    starting_values,
)
from l2m_gtsam.calibration.uncertain_optimum import UncertainOptimum
from l2m_gtsam.calibration.uncertain_rounds import Beginning, Settled, settle_by_any
from l2m_gtsam.calibration.view import REOBSERVE_M
from l2m_gtsam.parallel.threads import side_by_side
from l2m_gtsam.records.error_budget import DisturbanceKind, StatedSize

SEARCHED = 0.6  # of the way, when it is known which processes a drive has


@dataclass(frozen=True)
class UncertainSolution:
    """An estimate and the solutions of its sensors.

    Attributes
    ----------
    estimate
        All sensors.
    solved
        Covariance and figures of each.
    ending
        How the last optimisation ended.
    unsettled
        Sensors whose estimate or weights another round would change.
    budget
        Processes that were found in what noise and map leave.
    stated
        How large errors are whose sigmas were stated.
    by_parts
        The sensors by the scatter of parts of the drive alone, where that is asked for.
    unseen_warp_m
        Shifts of the drive's frame that readings leave possible, metres, root mean square; absent
        where they are estimated or not counted.
    """

    estimate: Estimate
    solved: tuple[SensorSolution, ...]
    ending: Ending
    unsettled: frozenset[int]
    budget: Budget = NOTHING_FOUND
    stated: tuple[StatedSize, ...] = ()
    by_parts: tuple[ByParts, ...] = ()
    unseen_warp_m: float | None = None


def solve_uncertain(
    near: IndependentOptimum, progress: Callable[[float], None]
) -> UncertainSolution:
    """Finish a calibration with the map's error as part of the graph.

    Parameters
    ----------
    near
        The optimum with independent errors.
    progress
        Called with the fraction that is done.
    """
    progress(0.0)
    drive, view = UncertainDrive.of(near), near.view
    found = settle_by_any(drive, near.estimate, lambda done: progress(SEARCHED * done))
    # Processes would take up what is stated too small: it is judged without them.
    stated = found.optimum.stated(near.options.sensor_noise_ut)
    if short := noise_is_short(stated):
        # White readings would be several times what they should, and anything would explain them.
        options = near.options.model_copy(update={"sensor_noise_ut": None})
        noisier = replace(found.estimate, noise=found.optimum.noise())
        near = replace(near, estimate=noisier, options=options)
        found = settle_by_any(replace(drive, options=options), noisier, lambda _: None)
    searched = found.ending is not Ending.SINGULAR
    searched = searched and leave_noise(stated, found.estimate.noise[view.sensors])
    known = found.optimum.informed() if searched else None
    shown = search(known) if known else NOTHING_SEARCHED
    if shown.found:
        moved = float(np.abs(found.estimate.t - near.estimate.t)[view.sensors].max())
        start = start_with(found, shown, near, again=moved > REOBSERVE_M)
        found = settle_by_any(
            start.drive,
            start.estimate,
            lambda done: progress(SEARCHED + (1 - SEARCHED) * done),
            start.begin,
        )
    if short:
        left = found.estimate.noise / near.estimate.noise
        stated = beside_processes(stated, view.readings.sensors, left)
    stated = of_its_sensor(stated, shown.found, near)
    optimum = found.optimum
    solved, size = optimum.by_cause(optimum.solutions()), None
    if known is not None and near.options.warp_m > 0 and found.drive.budget.warp is None:
        of_warp = optimum.informed_of_warp() if shown.found else known.of_kind(DisturbanceKind.WARP)
        unseen = unseen_warp(of_warp, near.options.warp_m)
        solved, size = optimum.with_unseen(solved, unseen), unseen.size_m
    scattered, halved = side_by_side(optimum.scattered, lambda: optimum.halved(solved))
    solved = optimum.wandering(optimum.robust(halved, scattered))
    progress(1.0)
    return UncertainSolution(
        estimate=found.estimate,
        solved=solved,
        ending=found.ending,
        unsettled=found.unsettled,
        budget=found.drive.budget,
        stated=stated,
        unseen_warp_m=size,
    )


def check_by_parts(near: IndependentOptimum) -> UncertainSolution:
    """Return solutions without any process, with what the scatter of parts of the drive says."""
    found = settle_by_any(UncertainDrive.of(near), near.estimate, lambda _: None)
    return UncertainSolution(
        found.estimate,
        found.optimum.solutions(),
        found.ending,
        found.unsettled,
        by_parts=found.optimum.by_parts(),
    )


def of_its_sensor(
    stated: tuple[StatedSize, ...], found: Sequence[FoundProcess], near: IndependentOptimum
) -> tuple[StatedSize, ...]:
    """Return sizes where errors of poses are said of the sensor that alone shows them, if one does.

    A step without the sensor whose H changes most clearly tells.

    Parameters
    ----------
    stated, found
        Sizes that all sensors show, and the processes.
    near
        As of ``solve_uncertain``.
    """
    suspect, view = moved_most(found), near.view
    if suspect is None or not poses_too_small(stated) or len(view.sensors) < 2:
        return stated
    others = [sensor for sensor in view.sensors if sensor != suspect]
    part = view.select(view.readings.sensor != suspect, others)
    without = step_to_optimum(replace(near, view=part)).optimum
    return shown_by_one(stated, without.stated(None), view.readings.sensors[suspect])


def moved_most(found: Sequence[FoundProcess]) -> int | None:
    """Return the sensor whose H changes on the drive most clearly, if that of any does."""
    changing = (DisturbanceKind.MOVING_PARTS, DisturbanceKind.WANDER)
    own = [each for each in found if each.process.kind in changing]
    return max(own, key=lambda each: each.gain).process.sensor if own else None


@dataclass(frozen=True)
class ProcessStart:
    """Where a graph with processes of the drive begins.

    Attributes
    ----------
    drive
        What readings share, the processes with it.
    estimate
        All sensors, with the noise that the processes leave.
    begin
        All variables; absent where they are not those of the graph before.
    """

    drive: UncertainDrive
    estimate: Estimate
    begin: Beginning | None


def start_with(
    found: Settled, shown: Searched, near: IndependentOptimum, *, again: bool
) -> ProcessStart:
    """Return where the rounds begin with processes that a graph without them has shown.

    Parameters
    ----------
    found
        That graph at its optimum.
    shown
        The processes.
    near
        As of ``solve_uncertain``.
    again
        Whether the map has to be asked again where sensors are.
    """
    budget, estimate = Budget(shown.found), found.estimate
    if near.options.sensor_noise_ut is None:
        estimate = replace(estimate, noise=estimate.noise * np.sqrt(shown.noise))
    if budget.poses is None and not again:
        values = with_processes(found, budget, shown)
        estimate = estimate.updated(values, found.drive.view.sensors)
        optimum = found.optimum
        likely = optimum.problem.at_likely_poses(optimum.values)
        begin = Beginning(values, near=True, readings=likely)
        return ProcessStart(found.drive.beside(budget), estimate, begin)
    drive = UncertainDrive.of(replace(near, estimate=estimate), budget)
    return ProcessStart(drive, estimate, None)


def with_processes(found: Settled, budget: Budget, shown: Searched) -> gtsam.Values:
    """Return where the optimum is with processes that are no errors of poses, to first order."""
    values = found.optimum.joint.stepped(found.optimum.values, shown.moved)
    # Each has a variable of its own.
    for key, weights in zip(budget.variables, shown.weights, strict=True):
        values.insert(key, weights)
    return values


def step_uncertain(near: IndependentOptimum, budget: Budget = NOTHING_FOUND) -> UncertainSolution:
    """Return the same after a single Gauss-Newton step, with the weights at its start.

    From the optimum with independent errors that is exact but for products of C and shared errors.
    The budget has processes that are known beforehand.
    """
    step = step_to_optimum(near, budget)
    solved = step.optimum.solutions()
    return UncertainSolution(step.estimate, solved, step.ending, step.unsettled)


def step_to_optimum(near: IndependentOptimum, budget: Budget = NOTHING_FOUND) -> Settled:
    """Return where such a step ends. Parameters are those of ``step_uncertain``."""
    estimate, sensors = near.estimate, near.view.sensors
    places = ReadingPlaces.of(near.view.readings, near.field_map, estimate)
    drive = UncertainDrive.of(near, budget.at(places))
    problem = UncertainProblem(drive, estimate)
    step = step_by_any(problem, starting_values(estimate, sensors, drive.coverage))
    if problem.noise.pose is not None:
        likely = problem.at_likely_poses(step.values)
        problem = UncertainProblem(drive, estimate, readings=likely)
        step = step_by_any(problem, step.values)
    estimate = estimate.updated(step.values, sensors)
    optimum = UncertainOptimum.at(problem, step.values)
    return Settled(optimum, estimate, step.ending, frozenset())


def step_by_any(problem: UncertainProblem, values: gtsam.Values) -> Optimised:
    """Take one Gauss-Newton step by Cholesky, and where that is refused by QR."""
    for solver in (LinearSolver.CHOLESKY, LinearSolver.QR):
        step = problem.polish(values, 1, solver)
        if step.ending is not Ending.SINGULAR:
            break
    return step
