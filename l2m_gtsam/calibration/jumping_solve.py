"""The solve where H of a sensor jumps: from one moment on it reads another field wherever it is.

Processes cannot follow a jump, and steel along the rest of the path is a bad likeness of it. Jumps
are looked for beside what a solve found, taken off the readings, and all is solved again; what is
left of each is a variable of the graph. H is that of the end of the drive.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from l2m_gtsam.calibration.averages import Averages
from l2m_gtsam.calibration.changed_places import (
    ChangesOptions,
    averaged_drive,
    is_place_of,
    suspected,
)
from l2m_gtsam.calibration.coverage import Correction, UncertainMap
from l2m_gtsam.calibration.drive_sources import REJECTED
from l2m_gtsam.calibration.moving_solve import MovingProblem, MovingSolution, solve_moving
from l2m_gtsam.calibration.offset_courses import courses_of
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.records.error_budget import MOST_JUMPS, OffsetJump

ROUNDS = 5
SETTLED_SIGMAS = 1.0  # by which averages may see a jump otherwise than the graph does
SURE_SIGMAS = 5.0  # of a jump that stays one when all is solved with it


@dataclass(frozen=True)
class JumpingSolve:
    """A solve with the jumps that it knows of.

    Attributes
    ----------
    problem
        What was solved: readings without jumps, and their numbers.
    outcome
        Of the solve.
    jumps
        Of H, in order of time.
    """

    problem: MovingProblem
    outcome: MovingSolution
    jumps: tuple[OffsetJump, ...] = ()


def solve_jumping(
    problem: MovingProblem, t_start: FloatArray, options: ChangesOptions
) -> JumpingSolve:
    """Solve, look for jumps of H, and solve again with them until both agree.

    Parameters
    ----------
    problem
        What to solve.
    t_start
        Where to start each sensor in the lidar frame in metres, shape (S, 3).
    options
        How readings are averaged.
    """
    plain = solved = JumpingSolve(problem, solve_moving(problem, t_start))
    for _ in range(ROUNDS):
        solution = solved.outcome.solution
        read = replace(solution.readings, field=problem.readings.field)
        jumps = shown_jumps(replace(solution, readings=read), problem.field_map, options)
        if not jumps:
            return plain
        if _settled(jumps, solved.jumps):
            break
        solved = _solved_beside(problem, solution.estimate.t, jumps)
    sure = all(_sigmas(each.change, each.sigma) > SURE_SIGMAS for each in solved.jumps)
    return solved if sure else plain


def shown_jumps(
    solution: OneKeySolution, field_map: QueryableMap, options: ChangesOptions
) -> tuple[OffsetJump, ...]:
    """Return the jumps of H that readings of a solve show beside its processes.

    They are looked for where something else than noise was found: a process, or places that differ
    from the map. A sensor that jumps often wanders, which is a process, as a drift is.
    """
    if not isinstance(field_map, UncertainMap) or not is_place_of(field_map):
        return ()
    if solution.contradicted or not solution.comparable:
        return ()
    drive = averaged_drive(solution, field_map, options)
    if not solution.budget.found and not len(suspected(drive, field_map, options.averaging)):
        return ()
    rows = drive.marginal(field_map, field_map, solution.budget, options.averaging)
    shown = courses_of(rows.without(single(drive.averages)), drive).records(drive.view.readings)
    jumps = [each for each in shown if isinstance(each, OffsetJump)]
    often = Counter(each.sensor for each in jumps)
    return tuple(each for each in jumps if often[each.sensor] < MOST_JUMPS)


def single(averages: Averages) -> list[int]:
    """Return the rejected averages before and after which those of the sensor counted.

    One that is far off explains more than a jump does; of a jump many are rejected, or none.
    """
    order = np.lexsort((averages.readings.stamp_ns, averages.readings.sensor))
    wrong, sensor = averages.counted[order] < REJECTED, averages.readings.sensor[order]
    beside = wrong[1:] & wrong[:-1] & (np.diff(sensor) == 0)
    alone = wrong & ~np.append(False, beside) & ~np.append(beside, False)
    return [int(each) for each in order[alone]]


def _solved_beside(
    problem: MovingProblem, t: FloatArray, jumps: Sequence[OffsetJump]
) -> JumpingSolve:
    """Return the solve from some places on without jumps, and these as it finds them."""
    numbered = _numbered(problem.readings, jumps)
    columns = 1 + max(each.column for each in numbered)
    field, steps = problem.readings.field.copy(), np.zeros((len(problem.readings), columns))
    for each in numbered:
        steps[each.before, each.column] = -1.0  # H is that of the end
        field[each.before] += each.jump.change
    beside = replace(problem, readings=replace(problem.readings, field=field), steps=steps)
    outcome = solve_moving(beside, t)
    left = {each.sensor: each.moving for each in outcome.solution.solved}
    found = tuple(_as_found(each, left.get(each.sensor), columns) for each in numbered)
    return JumpingSolve(beside, outcome, found)


@dataclass(frozen=True)
class _NumberedJump:
    """A jump with its sensor, the number that stands for it there, and the readings before it."""

    jump: OffsetJump
    sensor: int
    column: int
    before: IntArray


def _numbered(readings: Readings, jumps: Sequence[OffsetJump]) -> list[_NumberedJump]:
    """Return jumps in their order: those of one sensor have numbers of their own."""
    found: list[_NumberedJump] = []
    for jump in jumps:
        sensor = readings.sensors.index(jump.sensor)
        column = sum(each.sensor == sensor for each in found)
        own = (readings.sensor == sensor) & (readings.stamp_ns < jump.stamp_ns)
        found.append(_NumberedJump(jump, sensor, column, np.flatnonzero(own)))
    return found


def _as_found(each: _NumberedJump, left: Correction | None, columns: int) -> OffsetJump:
    """Return a jump with what a solve found beyond it; as it was where that solved nothing."""
    if left is None:
        return each.jump
    at = each.column - columns  # jumps come after the recorded numbers
    change = np.add(each.jump.change, left.h[at])
    return replace(each.jump, change=tuple(change.tolist()), sigma=tuple(left.sigma[at].tolist()))


def _settled(jumps: Sequence[OffsetJump], before: Sequence[OffsetJump]) -> bool:
    """Return whether jumps are those before, to a sigma."""
    if [(e.sensor, e.stamp_ns) for e in jumps] != [(e.sensor, e.stamp_ns) for e in before]:
        return False
    pairs = zip(jumps, before, strict=True)
    return all(
        _sigmas(np.subtract(new.change, old.change), old.sigma) < SETTLED_SIGMAS
        for new, old in pairs
    )


def _sigmas(change: ArrayLike, sigma: ArrayLike) -> float:
    """Return how many sigmas long a change is; none along axes of which readings say nothing.

    The sigma of these is zero: of readings on one side of a jump none is used.
    """
    known = np.asarray(sigma) > 0
    return float(np.linalg.norm(np.divide(change, sigma, out=np.zeros(3), where=known)))
