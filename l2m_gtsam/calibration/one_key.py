"""The one-key solve: from readings and a map to t, C, H and their uncertainty.

The paper's algorithm 1, in three stages. The *alternation* brings t near: the distortion follows in
closed form from what the map predicts at the current t (w-RRTLS), then the graph over all ``T(i)``
moves the sensors, with the same weights inside and outside. The *joint* graph over ``T(i)`` and
``D(i)`` then finishes both, with the full covariance of each reading. Where readings share errors,
as those of a map that knows its own, the *last* graph has these as variables, too (``uncertain``).
The marginals of whichever comes last are the uncertainty. All sensors are in one graph and share
one evaluation of the map.

Where the lidar's motion separates a sensor's time offset from its place, ``S(i)`` is a variable,
too; the readings' poses are taken anew as it moves.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from l2m_gtsam.calibration.alternation import Alternated, OneKeyOptions, alternate, start_estimate
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND, Budget
from l2m_gtsam.calibration.contradiction import is_contradicted
from l2m_gtsam.calibration.coverage import NothingShared, UncertainMap
from l2m_gtsam.calibration.drive_noise import with_drive_noise
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint import (
    JointProblem,
    SensorSolution,
    joint_problem,
    joint_step,
    robust_solutions,
    sensor_solutions,
)
from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.calibration.parts_alone import ByParts
from l2m_gtsam.calibration.pose_durations import duration_of_poses
from l2m_gtsam.calibration.priors import NO_PRIORS, Priors
from l2m_gtsam.calibration.stayed import stayed, without
from l2m_gtsam.calibration.trust import NOTHING, Trusted, plausible, trusted
from l2m_gtsam.calibration.uncertain import (
    UncertainSolution,
    check_by_parts,
    solve_uncertain,
    step_uncertain,
)
from l2m_gtsam.calibration.uncertain_graph import IndependentOptimum
from l2m_gtsam.calibration.view import (
    REOBSERVE_M,
    QueryableMap,
    RememberedMap,
    StandIns,
    View,
    glimpse,
    has_left,
    inside_of_each,
    observe,
    places_of,
    remembered,
    seen_from,
    spread,
)
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, Readings, Trajectory
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.records.error_budget import PoseDuration, StatedSize
from l2m_gtsam.solve.rank import RankOptions

# The joint graph is solved again while its frozen weights still change; they settle in two or
# three rounds, and a set of readings that keeps hopping over the map's edge is cut off here.
MAX_ROUNDS = 10
SETTLED_M = 1e-5
# A vehicle moves a tenth of a millimetre meanwhile.
SETTLED_S = 1e-4
SINGULAR = 1e6  # condition of a C that is not to be inverted


@dataclass(frozen=True)
class OneKeySolution:
    """The estimate of all sensors and, for those that could be solved, how good it is.

    Attributes
    ----------
    readings
        All N readings, with their poses at the estimated time offsets.
    estimate
        Values of all S sensors; what stands for one that is not solved means nothing.
    solved
        Solutions of the sensors that have enough readings inside the map.
    inside
        Which readings lie inside the map at the estimate, shape (N,).
    rejected
        Which of them do not count, for no distortion explains them beside the others, shape (N,).
    steps
        Alternations taken.
    ending
        How the last joint optimisation ended.
    unsettled
        Sensors whose estimate or weights another round would change.
    uncertainty
        How the map's errors were counted: full needs a map that knows them.
    budget
        Processes that were found beside noise and the map's errors, where these are counted.
    stated
        How large errors are whose sigmas were stated, where shared errors are counted.
    pose_duration
        How long errors of poses last; none where these are taken as exact, or no map was asked.
    by_parts
        The sensors by the scatter of parts of the drive alone, where that is asked for.
    unseen_warp_m
        As of ``UncertainSolution``.
    stayed
        Sensors that the solve drives out of the map: they are where they started.
    contradicted
        Whether readings contradict the map: what it predicts is not in them. Errors that it shares
        are not looked for then.
    """

    readings: Readings
    estimate: Estimate
    solved: tuple[SensorSolution, ...]
    inside: BoolArray
    rejected: BoolArray
    steps: int
    ending: Ending
    unsettled: frozenset[int]
    uncertainty: Uncertainty = Uncertainty.INDEPENDENT
    budget: Budget = NOTHING_FOUND
    stated: tuple[StatedSize, ...] = ()
    pose_duration: PoseDuration | None = None
    by_parts: tuple[ByParts, ...] = ()
    unseen_warp_m: float | None = None
    stayed: frozenset[int] = frozenset()
    contradicted: bool = False

    @property
    def used(self) -> BoolArray:
        """Which readings count, shape (N,)."""
        return self.inside & ~self.rejected

    @property
    def comparable(self) -> tuple[int, ...]:
        """Solved sensors whose readings say what the field is at a place in the map.

        Not those that stayed where they started, nor those with a dead axis.
        """
        whole = np.linalg.cond(self.estimate.C()) < SINGULAR
        solved = [each.sensor for each in self.solved]
        return tuple(each for each in solved if whole[each] and each not in self.stayed)


def solve_one_key(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    options: OneKeyOptions,
    progress: Progress = silent,
    trajectory: Trajectory | None = None,
    priors: Priors = NO_PRIORS,
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
    trajectory
        The lidar's poses, to take those of the readings anew for other time offsets; without it
        they go on as they move.
    priors
        What is known of the sensors beforehand.
    """
    stage = partial(progress, "map uncertainty")
    finish = Finish(robust_solutions, partial(solve_uncertain, progress=stage))
    return _solved(readings, field_map, t_start, options, progress, trajectory, priors, finish)


def solve_part(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    options: OneKeyOptions,
    budget: Budget = NOTHING_FOUND,
) -> OneKeySolution:
    """Calibrate all sensors on a part of what the whole was calibrated on.

    As ``solve_one_key``, but the graph over an uncertain map is solved once, with the weights of
    the joint graph, and not until its own have settled.

    Parameters
    ----------
    readings, field_map, options
        As of ``solve_one_key``.
    t_start
        Where the whole was found, metres, shape (S, 3).
    budget
        Processes that the whole has.
    """
    finish = Finish(sensor_solutions, partial(step_uncertain, budget=budget))
    return _solved(readings, field_map, t_start, options, silent, None, NO_PRIORS, finish)


def solve_by_parts(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, options: OneKeyOptions
) -> tuple[ByParts, ...]:
    """Return what the scatter of parts of a drive says of sensors, without looking for processes.

    Nothing where the map does not know its errors.

    Parameters
    ----------
    readings, field_map, options
        As of ``solve_one_key``.
    t_start
        Where sensors were found, metres, shape (S, 3).
    """
    finish = Finish(sensor_solutions, check_by_parts)
    found = _solved(readings, field_map, t_start, options, silent, None, NO_PRIORS, finish)
    return found.by_parts


@dataclass(frozen=True)
class Finish:
    """How covariances come from the optimum with independent errors.

    Attributes
    ----------
    independent
        Over a map whose errors are independent.
    shared
        Over a map that knows its errors.
    """

    independent: Callable[[JointProblem, Estimate], tuple[SensorSolution, ...]]
    shared: Callable[[IndependentOptimum], UncertainSolution]


@one_blas_thread()
def _solved(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    options: OneKeyOptions,
    progress: Progress,
    trajectory: Trajectory | None,
    priors: Priors,
    finish: Finish,
) -> OneKeySolution:
    asked = remembered(field_map)
    stand_ins = StandIns.of(readings, options.fewer_readings)
    keep = spread(readings, options.some_readings)
    some, of_some = readings.select(keep), stand_ins.select(keep)
    good = plausible(some, of_some.sample(some, asked, t_start, t_start), options.robust)
    some, of_some = some.select(good), of_some.select(good)
    start = start_estimate(t_start, options, priors)
    near = alternate(some, of_some, asked, start, options, progress)
    if options.sensor_noise_ut is None:
        readings = with_drive_noise(readings, stand_ins, asked, near)
    joint = settle(readings, stand_ins, asked, near, options, progress, trajectory)
    alone = stayed(joint.stayed, joint.readings, asked, joint.estimate, options)
    joint = replace(joint, estimate=alone.estimate)
    outcome = OneKeySolution(
        readings=joint.readings,
        estimate=joint.estimate,
        solved=alone.solved,
        inside=joint.whole.inside,
        rejected=joint.rejected | alone.rejected,
        steps=near.steps,
        ending=joint.ending,
        unsettled=joint.unsettled,
        stayed=joint.stayed,
    )
    if joint.problem is None:
        return outcome
    view, tests = joint.problem.view, joint.problem.determinacies
    errors = shared_errors(asked, view.readings, options.uncertainty)
    contradicted = is_contradicted(view, joint.estimate, tests)
    if errors is None or contradicted:
        found = in_order(finish.independent(joint.problem, joint.estimate), alone.solved)
        return replace(outcome, solved=found, contradicted=contradicted)
    poses = options.pose_noise
    if duration := duration_of_poses(view, asked, joint.estimate, poses, trajectory):
        options = options.model_copy(update={"pose_noise": poses.lasting(duration.seconds)})
    optimum = IndependentOptimum(view, asked, errors, joint.estimate, tests, options)
    full = finish.shared(optimum)
    remember_near(asked, joint, full.estimate)
    unshared = isinstance(errors, NothingShared)
    return replace(
        outcome,
        estimate=full.estimate,
        solved=in_order(full.solved, alone.solved),
        ending=full.ending,
        unsettled=joint.unsettled | full.unsettled,
        uncertainty=Uncertainty.INDEPENDENT if unshared else Uncertainty.FULL,
        budget=full.budget,
        stated=full.stated,
        pose_duration=duration,
        by_parts=full.by_parts,
        unseen_warp_m=full.unseen_warp_m,
    )


def in_order(*parts: tuple[SensorSolution, ...]) -> tuple[SensorSolution, ...]:
    """Return the solutions of all sensors in the order of these."""
    return tuple(sorted((each for part in parts for each in part), key=lambda each: each.sensor))


def remember_near(field_map: RememberedMap, joint: "Joint", estimate: Estimate) -> None:
    """Let the map remember its variance where sensors are found: it was asked near by.

    Field and gradient are those of the places themselves.
    """
    x = places_of(joint.whole.readings, estimate.t)
    near = np.abs(x - joint.asked).max(axis=1) <= REOBSERVE_M
    field, gradient = field_map.field_and_gradient(x[near])
    variance, inside = joint.whole.map_variance[near], np.ones(len(field), dtype=np.bool_)
    field_map.remember(x[near], FieldSample(field, gradient, variance, inside))


def shared_errors(
    field_map: QueryableMap, readings: Readings, uncertainty: Uncertainty
) -> UncertainMap | None:
    """Return the errors that are variables beside the sensors; none if nothing is shared.

    Fields of recorded numbers are shared whatever is known of the map.
    """
    if uncertainty is Uncertainty.FULL and isinstance(field_map, UncertainMap):
        return field_map
    return None if readings.regressors is None else NothingShared()


@dataclass(frozen=True)
class Joint:
    """Where the joint graph settled.

    Attributes
    ----------
    readings
        All, with their poses at the estimated time offsets.
    estimate
        All sensors.
    whole
        The readings inside the map.
    asked
        Where the map was asked for its variance at these, metres, shape (M, 3).
    weights
        How far each of them counts, shape (M,).
    problem
        The graph of those that count; none if no sensor has enough.
    ending
        How the last optimisation ended.
    unsettled
        Sensors whose estimate or weights another round would change.
    stayed
        Sensors that left the map, and are where the rounds began; their readings are not among
        those inside.
    """

    readings: Readings
    estimate: Estimate
    whole: View
    asked: FloatArray
    weights: FloatArray
    problem: JointProblem | None
    ending: Ending
    unsettled: frozenset[int]
    stayed: frozenset[int]

    @property
    def rejected(self) -> BoolArray:
        """Which of all readings lie inside the map and do not count, shape (N,)."""
        rejected = np.zeros(len(self.whole.inside), dtype=np.bool_)
        rejected[self.whole.rows] = self.weights <= NOTHING
        return rejected


def settle(
    readings: Readings,
    stand_ins: StandIns,
    field_map: QueryableMap,
    near: Alternated,
    options: OneKeyOptions,
    progress: Progress,
    trajectory: Trajectory | None,
) -> Joint:
    """Solve the joint graph again and again, until the weights are those of its result.

    That is the graduated loop too: each round trusts readings as the residuals of the last say.
    Sensors that leave the map go back to where they were, and take no part any more.
    """
    # The first round moves all sensors: a few readings' variance is enough for it.
    estimate, least = near.estimate, options.min_readings
    whole = glimpse(readings, stand_ins, field_map, estimate, near.asked, least)
    begun, gone = inside_of_each(readings, whole), frozenset[int]()
    asked = np.full((len(whole.readings), 3), np.inf)
    ending, unsettled = Ending.TOLERANCE, frozenset(range(len(estimate.t)))
    last: Trusted | None = None
    problem: JointProblem | None = None
    for round_ in range(MAX_ROUNDS):
        progress("joint graph", round_ / MAX_ROUNDS)
        now = trusted(whole, field_map, estimate, options, round_, last)
        if not now.view.sensors:
            return Joint(
                readings, estimate, whole, asked, now.weights, None, ending, unsettled - gone, gone
            )
        problem = joint_problem(now.view, field_map, estimate, options)
        step = joint_step(problem, estimate, options, exact=now.agrees(last))
        unsettled = frozenset(
            s
            for s in now.view.sensors
            if is_changing(s, problem, estimate, step.estimate, options.rank)
            or not now.agrees_on(s, last)
        )
        late = float(np.abs(step.estimate.offset - estimate.offset).max())
        estimate, ending, last = step.estimate, step.ending, now
        if not unsettled:
            break
        if late > SETTLED_S and trajectory is not None:
            readings = with_offsets(readings, trajectory, estimate.offset)
            whole = replace(whole, readings=readings[whole.rows])
        if np.abs(places_of(whole.readings, estimate.t) - asked).max() > REOBSERVE_M:
            whole = observe(readings, field_map, estimate, options.min_readings)
            if (left := has_left(readings, whole, begun)).any():
                gone |= frozenset(np.flatnonzero(left).tolist())
                t = np.where(left[:, None], near.estimate.t, estimate.t)
                estimate = replace(estimate, t=t)
                whole = observe(readings, field_map, estimate, options.min_readings)
            whole = without(whole, gone)
            asked = places_of(whole.readings, estimate.t)
        else:
            whole = seen_from(whole, field_map, estimate)
    progress("joint graph", 1.0)
    if last is None or unsettled:  # the last round's weights are not those of its result
        last = trusted(whole, field_map, estimate, options, MAX_ROUNDS, None)
        problem = joint_problem(last.view, field_map, estimate, options)
    return Joint(
        readings, estimate, whole, asked, last.weights, problem, ending, unsettled - gone, gone
    )


def is_changing(
    sensor: int, problem: JointProblem, before: Estimate, after: Estimate, options: RankOptions
) -> bool:
    """Return whether a sensor moved in a round, or its clock, or its noise differs.

    Where they leave its place open it may go wherever it likes along what they do not determine.

    Parameters
    ----------
    sensor
        Index of the sensor.
    problem
        The round.
    before, after
        Estimates before and after it.
    options
        The scales of the rank test.
    """
    step = after.t[sensor] - before.t[sensor]
    test = problem.determinacies[sensor]
    if test.place_open:
        known = test.determined
        scale = options.scale()
        whole = (after.vector(sensor) - before.vector(sensor)) / scale
        step = (scale * (known.T @ (known @ whole)))[:3]
    late = abs(after.offset[sensor] - before.offset[sensor])
    moved = float(np.abs(step).max()) >= SETTLED_M or late >= SETTLED_S
    return moved or not after.same_noise(before, sensor)
