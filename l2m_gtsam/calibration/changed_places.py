"""Places that changed since they were mapped: suspected, explained, taken into the solve.

Sources are looked for in all readings inside the map, whether the solve trusted them or not: what
was rejected is where a change is plainest. Then the map is given the sources and everything is
solved again, with the sources as variables beside the sensors: readings that they explain count.
"""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive, pose_shares
from l2m_gtsam.calibration.averages import AveragingOptions, averaged
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND
from l2m_gtsam.calibration.coverage import UncertainMap, errors_over_stated
from l2m_gtsam.calibration.drive_sources import REJECTED, drive_sources, offset_gain
from l2m_gtsam.calibration.moving_solve import MovingProblem, MovingSolution, solve_moving
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.view import QueryableMap, RememberedMap, places_of
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.changed_map import ChangedMap
from l2m_gtsam.maps.sources.found_sources import FoundSources
from l2m_gtsam.maps.sources.search import SourceSearchOptions
from l2m_gtsam.options import Options
from l2m_gtsam.records.places import ChangedSource
from l2m_gtsam.solve.chi_square import quantile

CELL_M = 1.0  # edge of the cells that are suspected
SURE = 0.999  # of cells with nothing but noise so many are not
ENOUGH, UNLIKE = 10, 2.0  # readings of a cell, and their squares over those of most cells
AXES = 3
# Errors of a map over what it states, at held-out readings of its survey: with more of them its
# model is not the place's. Up to this they count as large as they are.
MOST_OVER_STATED = 3.0
ROUNDS = 4  # of solving with sources and looking for them again
SETTLED_SIGMAS = 0.3


class ChangesOptions(Options):
    """How places are judged that differ from the map."""

    sources: SourceSearchOptions = SourceSearchOptions()
    """How sources are looked for that came, went or were moved."""
    averaging: AveragingOptions = AveragingOptions()
    """How readings are averaged for it."""


@dataclass(frozen=True)
class ChangedSources:
    """Sources as a graph takes them, and as they are reported.

    Attributes
    ----------
    found
        All of them.
    records
        Those that changed since the survey.
    missed
        Places of those that stood there already and are not in the map, metres, shape (M, 3).
    """

    found: FoundSources
    records: tuple[ChangedSource, ...]
    missed: FloatArray


def averaged_drive(
    solution: OneKeySolution, field_map: QueryableMap, options: ChangesOptions
) -> AveragedDrive:
    """Return averages of comparable readings inside the map, rejected ones among them."""
    inside = solution.inside & np.isin(solution.readings.sensor, solution.comparable)
    readings = solution.readings.select(inside)
    estimate = solution.estimate
    used, nearest = solution.used[inside], options.sources.nearest
    averages = averaged(readings, field_map, estimate, used, options.averaging, nearest)
    return AveragedDrive.of(averages, field_map, estimate)


def suspected(
    drive: AveragedDrive, field_map: QueryableMap, options: AveragingOptions
) -> FloatArray:
    """Return where readings differ from the map by more than it may err, metres, shape (M, 3).

    Cell by cell of the floor, with all errors of the map in a cell alike: quick, and no more than
    a first look. Beside small steel the field differs by ways that cancel in a cell's mean: there
    the squares are larger than elsewhere on the drive.
    """
    readings, estimate = drive.view.readings, drive.estimate
    places = places_of(readings, estimate.t)
    _, cell = np.unique(np.floor(places[:, :2] / CELL_M), axis=0, return_inverse=True)
    count = np.bincount(cell)
    shares = pose_shares(readings, field_map, estimate, options)
    noise = readings.noise(drive.averages.noise)
    own = np.einsum("nij,nij->ni", shares, shares) + noise[:, None] ** 2

    def mean(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(cell, each) for each in values.T], axis=1) / count[:, None]

    # Sensors share errors of poses: an average over cells of all of them is no better for it.
    sensors = len(np.unique(readings.sensor))
    variance = mean(drive.map_variance) + mean(own) * sensors / np.maximum(count, sensors)[:, None]
    left = drive.averages.residual
    wrong = np.sum(mean(left) ** 2 / variance, axis=1) > quantile(SURE, AXES)
    single = mean(left**2 / (drive.map_variance + own)).sum(axis=1)
    wrong |= (count >= ENOUGH) & (single > UNLIKE * np.median(single))
    wrong |= 1 - np.bincount(cell, drive.averages.counted) / count > 0.5
    return np.asarray(mean(places)[wrong])


def is_place_of(field_map: QueryableMap) -> bool:
    """Return whether what a map misses may be a change, and not that it is wrong everywhere."""
    return errors_over_stated(field_map) <= MOST_OVER_STATED


def search(
    solution: OneKeySolution,
    field_map: QueryableMap,
    options: ChangesOptions,
    known: FoundSources | None,
) -> ChangedSources | None:
    """Return the sources that readings of a solve show; none if no place is suspected.

    Offsets of sensors that are on where readings were rejected are the other explanation of all
    these readings: if that is the better one, no place has changed.

    Parameters
    ----------
    solution
        The solve.
    field_map
        As it was surveyed.
    options
        How to look.
    known
        Sources that were found before, which the solve knows of.
    """
    if not options.sources.most or not isinstance(field_map, UncertainMap):
        return None
    if solution.contradicted:  # no place is as the map has it
        return None
    if not solution.comparable or not is_place_of(field_map):
        return None
    drive = averaged_drive(solution, field_map, options)
    places = suspected(drive, field_map, options.averaging)
    if not len(places) and known is None:
        return None
    # Steel that a solve does not know of is steel that its processes have swallowed. Those of a
    # solve that knows sources are what these have to stand beside.
    budget = NOTHING_FOUND if known is None else solution.budget
    rows = drive.marginal(field_map, field_map, budget, options.averaging)
    shown = drive_sources(rows, drive, places, field_map, options.sources, known)
    # Something on the vehicle that is switched does that, alike at all places.
    switched = offset_gain(shown.rows, drive, drive.averages.counted < REJECTED)
    if not len(shown.found) or shown.gain < switched:
        return None
    return ChangedSources(shown.found, shown.changed(), shown.missed_places)


@dataclass(frozen=True)
class ChangedSolve:
    """A solve with the sources that it knows of.

    Attributes
    ----------
    outcome
        Of the solve.
    solver_map
        The map that it was solved on: with the sources.
    sources
        What changed since the survey; none if nothing did.
    """

    outcome: MovingSolution
    solver_map: RememberedMap
    sources: ChangedSources | None

    @property
    def records(self) -> tuple[ChangedSource, ...]:
        """The sources as they are reported."""
        return () if self.sources is None else self.sources.records

    @property
    def doubts(self) -> tuple[str, ...]:
        """What speaks against the map, a sentence each."""
        missed = () if self.sources is None else self.sources.missed
        return tuple(
            f"it lacks steel at ({x:.1f}, {y:.1f}, {z:.1f}) m, which its survey shows as this drive"
            for x, y, z in missed
        )

    def taken_into(self, surveyed: QueryableMap) -> QueryableMap:
        """Return a map as it was surveyed with the sources that came, went or were moved."""
        return surveyed if self.sources is None else ChangedMap(surveyed, self.sources.found)


def solve_changed(
    problem: MovingProblem,
    solver_map: RememberedMap,
    without: MovingSolution,
    options: ChangesOptions,
) -> ChangedSolve:
    """Look for sources, and solve again with them until both agree.

    Parameters
    ----------
    problem
        What to solve, on the map as it was surveyed.
    solver_map
        That map.
    without
        The solve on it.
    options
        How to look for sources.
    """
    plain = solved = ChangedSolve(without, solver_map, None)
    for _ in range(ROUNDS):
        before = None if solved.sources is None else solved.sources.found
        sources = search(solved.outcome.solution, solver_map, options, before)
        if sources is None:
            return plain
        if settled(sources.found, before):
            return replace(solved, sources=sources)
        changed = RememberedMap(ChangedMap(solver_map, sources.found))
        t = solved.outcome.solution.estimate.t
        again = solve_moving(replace(problem, field_map=changed), t)
        solved = ChangedSolve(again, changed, sources)
    return solved


def settled(found: FoundSources, before: FoundSources | None) -> bool:
    """Return whether sources are where they were found before, to a share of their sigmas."""
    if before is None or len(before) != len(found):
        return False
    old, new = (np.concatenate([s.vector for s in each.shapes]) for each in (before, found))
    sigma = np.sqrt(np.diag(found.covariance))
    free = sigma > 0
    return bool((np.abs(new - old)[free] <= SETTLED_SIGMAS * sigma[free]).all())
