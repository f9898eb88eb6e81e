"""Where to start: the places that explain the readings best, without a guess.

The cost with C and H eliminated is looked at on a grid of places around the lidar, for all sensors
at once, on a map that costs nothing: the nearest reading of the survey. Its few best basins are
followed to their minima on the map itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.ndimage import minimum_filter

from l2m_gtsam.calibration.priors import NO_PRIORS, Priors
from l2m_gtsam.calibration.start.candidates import Candidates
from l2m_gtsam.calibration.start.descent import Basin, StartProblem, descend
from l2m_gtsam.calibration.start.rigid_groups import Bounds, Rigid, bounded, pooled, rigid_groups
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, Readings
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.options import Options
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.records.calibration import FoundStart
from l2m_gtsam.solve.profile import FieldPredictor, Snapshots, misfits, snapshots_of

BATCH = 256  # candidates at a time
ASKED = 24  # poses at which the map is asked whether it knows the field where a start is
FIRST = 10  # poses that decide whether a candidate lies in the map at all
STRIDE = 1.9  # steps of the grid: places nearer to a better one are not followed
TINY = np.finfo(float).tiny

Node = tuple[int, int, int, int]
"""A sensor, and a place in steps of the lattice."""
InMap = Callable[[FloatArray], bool]
"""Whether a sensor at a place, shape (3,), in metres, would read most of a drive inside the map."""


class StartOptions(Options):
    """How the start of the solve is looked for; lengths in metres."""

    search_radius: float = Field(default=3.0, gt=0, le=5)
    """Sensors are looked for so far around the lidar."""
    step: float = Field(default=0.25, ge=0.1)
    """Of the grid; the field of a building varies over about twice that. Finer grids than a
    decimetre would fill the memory."""
    poses: int = Field(default=120, ge=20)
    """Poses of the drive that take part, spread evenly over it."""
    reach: float = Field(default=0.5, gt=0)
    """A place is known to the coarse map when a reading of the survey is this near."""
    least_known: float = Field(default=0.5, gt=0, le=1)
    """A candidate counts if this share of the readings would lie in the map."""
    basins: int = Field(default=8, ge=2)
    """The most places of one sensor that are followed to their minima."""
    follow: float = Field(default=3.0, ge=1)
    """A place is followed if on the grid it leaves no more than so many times what the best one
    leaves (root mean square); there most of what is left is the grid's own coarseness."""
    outliers: float = Field(default=0.25, ge=0, lt=0.5)
    """Share of a sensor's readings that may be wrong: so many do not count."""
    apart: float = Field(default=0.2, gt=0)
    """Minima closer than this are one."""
    clear: float = Field(default=1.1, gt=1)
    """If the second best place leaves less than so many times what the best leaves (root mean
    square), the start is ambiguous."""


def find_starts(
    readings: Readings,
    field_map: QueryableMap,
    centre: FloatArray,
    options: StartOptions,
    priors: Priors = NO_PRIORS,
) -> list[FoundStart | None]:
    """Return where each sensor of a drive is; none where no candidate lies in the map.

    Parameters
    ----------
    readings
        Of all sensors.
    field_map
        The magnetic map.
    centre
        Middle of the search in the lidar frame in metres, shape (3,).
    options
        How wide and how fine to look.
    priors
        What is known beforehand: sensors are where coordinates were measured, and those with known
        vectors between them are looked for together.
    """
    return find_starts_around(readings, field_map, centre[None], options, priors)[0]


def find_starts_around(
    readings: Readings,
    field_map: QueryableMap,
    centres: FloatArray,
    options: StartOptions,
    priors: Priors = NO_PRIORS,
) -> list[list[FoundStart | None]]:
    """Return for each of several centres what ``find_starts`` does, looking at a place once.

    Parameters
    ----------
    readings
        Of all sensors.
    field_map
        The magnetic map.
    centres
        In the lidar frame in metres, shape (N, 3); the box about all of them is in memory.
    options
        How wide and how fine to look around each.
    priors
        What is known beforehand.
    """
    together = snapshots_of(readings, options.poses)
    bounds = Bounds.of(priors, len(readings.sensors))
    groups = rigid_groups(priors, np.flatnonzero(together.shared()).tolist())
    found = starts_of(together, field_map, centres, options, bounds, groups)
    for sensor in np.flatnonzero(~together.shared()).tolist():
        # A sensor that reads at other times than the rest is looked for by itself.
        rows = np.arange(len(readings))[readings.rows_of(sensor)]
        if len(rows):
            alone = snapshots_of(readings[rows], options.poses)
            by_itself = starts_of(alone, field_map, centres, options, bounds, [])
            for each, own in zip(found, by_itself, strict=True):
                each[sensor] = own[sensor]
    return found


def starts_of(
    snapshots: Snapshots,
    field_map: QueryableMap,
    centres: FloatArray,
    options: StartOptions,
    bounds: Bounds,
    groups: Sequence[Rigid],
) -> list[list[FoundStart | None]]:
    """Return where each sensor is, by centre, from readings at common poses.

    Parameters
    ----------
    snapshots
        The readings.
    field_map, centres, options
        As of ``find_starts_around``.
    bounds, groups
        Where sensors can be, and which of them move as one.
    """
    coarse = coarse_prediction(field_map, options)
    balls = [Candidates.around(centre, options.search_radius, options.step) for centre in centres]
    union = Candidates.union(balls)
    left = screen(snapshots, coarse, union, options)
    left = pooled(bounded(left, union.axes(), bounds), groups, options.step)
    candidates = [
        start_candidates(ball, np.where(ball.within, part, np.inf), sensor, options)
        for ball in balls
        for sensor, part in enumerate(np.moveaxis(left[ball.slices_of(union)], -1, 0))
    ]
    fine = fine_prediction(field_map, coarse)
    problem = StartProblem(snapshots, fine, field_map, options.step, 1 - options.outliers)
    followed = follow(problem, candidates, options.step, bounds)
    few = snapshots.thinned(ASKED)

    def in_map(t: FloatArray) -> bool:
        return bool(field_map.query(few.places(t[None])[0]).inside.mean() >= options.least_known)

    sensors, starts = left.shape[-1], []
    for row in range(0, len(candidates), sensors):
        own = candidates[row : row + sensors]
        found = [found_start(each, reached(each, followed), options, in_map) for each in own]
        for group in groups:
            place_group(group, problem, own, followed, options, in_map, found)
        starts.append(found)
    return starts


def follow(
    problem: StartProblem, candidates: list["StartCandidates"], step: float, bounds: Bounds
) -> dict[Node, Basin]:
    """Return the minimum that each node of any candidates leads to, of those that lead anywhere.

    One beyond the bounds is taken to their edge, and what is left there counts.
    """
    nodes = sorted({node for each in candidates for node in each.nodes})
    sensors = np.array([node[0] for node in nodes], dtype=np.int64)
    t = step * np.array([node[1:] for node in nodes]).reshape(-1, 3)
    ends = descend(problem, sensors, t)
    return {
        node: within(end, node[0], problem, bounds)
        for node, end in zip(nodes, ends, strict=True)
        if end is not None
    }


def within(basin: Basin, sensor: int, problem: StartProblem, bounds: Bounds) -> Basin:
    """Return a sensor's basin, or the nearest place where the sensor can be."""
    t = np.clip(basin.t, bounds.low[sensor], bounds.high[sensor])
    if (t == basin.t).all():
        return basin
    left = misfits(problem.snapshots, problem.predict, t[None], problem.good).rms
    return Basin(t, float(left[0, sensor]))


def reached(candidates: "StartCandidates", followed: dict[Node, Basin]) -> list[Basin]:
    """Return the basins that candidates led to."""
    return [followed[node] for node in candidates.nodes if node in followed]


def found_start(
    candidates: "StartCandidates", reached: Sequence[Basin], options: StartOptions, in_map: InMap
) -> FoundStart | None:
    """Return the best of the basins that a sensor's candidates led to, beside the second best.

    Where the field is much the same everywhere a descent may leave the map: there it explains
    nothing.

    Parameters
    ----------
    candidates, reached
        Of the sensor.
    options
        How far apart basins are.
    in_map
        Whether a place is one of the map.
    """
    basins = list(distinct(reached, options.apart))
    while basins and not in_map(basins[0].t):
        del basins[0]
    if not basins:
        return None
    best, margin, runner_up = basins[0], candidates.margin, candidates.runner_up
    if len(basins) > 1 and (ratio := basins[1].rms / max(best.rms, TINY)) < margin:
        margin, runner_up = ratio, basins[1].t
    return FoundStart(best.t, float(margin), runner_up)


def place_group(
    group: Rigid,
    problem: StartProblem,
    candidates: list["StartCandidates"],
    followed: dict[Node, Basin],
    options: StartOptions,
    in_map: InMap,
    found: list[FoundStart | None],
) -> None:
    """Replace what was found for each sensor of a group by where the whole group fits best.

    Every minimum of every sensor is a place for the group: a sensor that sees little of the field
    follows those that see more.
    """
    places = [
        basin.t - offset
        for sensor, offset in zip(group.sensors, group.offset, strict=True)
        for basin in reached(candidates[sensor], followed)
    ]
    if not places:
        return
    left = [
        misfits(problem.snapshots, problem.predict, np.array(places) + offset, problem.good).rms[
            :, sensor
        ]
        for sensor, offset in zip(group.sensors, group.offset, strict=True)
    ]
    mean = np.exp(np.mean(np.log(np.maximum(left, TINY)), axis=0))
    basins = [Basin(t, float(rms)) for t, rms in zip(places, mean, strict=True)]
    first = group.offset[0]
    start = found_start(candidates[group.sensors[0]], basins, options, lambda t: in_map(t + first))
    for sensor, offset in zip(group.sensors, group.offset, strict=True):
        found[sensor] = None if start is None else start.moved(offset)


def coarse_prediction(field_map: QueryableMap, options: StartOptions) -> FieldPredictor:
    """Return the nearest readings of a map that knows its own, and else the map.

    The first cost nothing to make: by them the region is found where the map is asked.
    """
    if isinstance(field_map, Surveyed):
        readings = field_map.readings

        def nearest(points: FloatArray) -> tuple[FloatArray, BoolArray]:
            away, row = readings.tree.query(points, distance_upper_bound=options.reach)
            known = np.isfinite(away)
            field = np.zeros((len(points), 3))
            field[known] = readings.field[np.asarray(row)[known]]
            return field, np.asarray(known)

        return nearest

    def predict(points: FloatArray) -> tuple[FloatArray, BoolArray]:
        sample = field_map.query(points)
        return np.where(sample.inside[:, None], sample.field, 0.0), sample.inside

    return predict


def fine_prediction(field_map: QueryableMap, coarse: FieldPredictor) -> FieldPredictor:
    """Return the map itself where the coarse one knows something: its variance is not asked."""

    def predict(points: FloatArray) -> tuple[FloatArray, BoolArray]:
        _, inside = coarse(points)
        field = np.zeros((len(points), 3))
        field[inside], _ = field_map.field_and_gradient(points[inside])
        return field, inside

    return predict


def screen(
    snapshots: Snapshots, predict: FieldPredictor, grid: Candidates, options: StartOptions
) -> FloatArray:
    """Return the misfits in uT of all nodes and sensors, shape (nx, ny, nz, S).

    They are infinite where too few readings would lie in the map.
    """
    left = np.full((*grid.within.shape, snapshots.field.shape[1]), np.inf)
    nodes, first = np.argwhere(grid.within), snapshots.thinned(FIRST)

    def write(start: int) -> None:
        at = nodes[start : start + BATCH]
        _, inside = predict(first.places(grid.t(at)).reshape(-1, 3))
        often = inside.reshape(len(at), -1).mean(axis=1) >= 0.5 * options.least_known
        if often.any():
            at = at[often]
            part = misfits(snapshots, predict, grid.t(at), 1 - options.outliers)
            left[tuple(at.T)] = np.where(part.known >= options.least_known, part.rms, np.inf)

    in_threads(write, range(0, len(nodes), BATCH))
    return left


@dataclass(frozen=True)
class StartCandidates:
    """Places to follow to their minima, for one sensor.

    Attributes
    ----------
    nodes
        The sensor and the place in steps of the lattice.
    margin
        How many times more (root mean square) the best place that is not followed leaves on the
        grid than the best of all; infinite if there is none.
    runner_up
        That place in metres, shape (3,), if there is one.
    """

    nodes: tuple[Node, ...]
    margin: float
    runner_up: FloatArray | None


def start_candidates(
    grid: Candidates, left: FloatArray, sensor: int, options: StartOptions
) -> StartCandidates:
    """Return the places of a ball that could, seen finely, lead to the best.

    Beside minima these are nodes some steps from better ones: the coarse map knows little of
    heights, and its minimum may lie over or under the true one. ``left`` is the sensor's misfits
    in uT, infinite outside of the ball, shape (nx, ny, nz).
    """
    nodes = np.argwhere(np.isfinite(left))
    value = left[tuple(nodes.T)]
    order = np.argsort(value, kind="stable")
    nodes, ratio = nodes[order], value[order]
    places, apart = grid.t(nodes), STRIDE * options.step
    ratio = ratio / max(ratio.min(initial=np.inf), TINY)
    picked = spread_out(places[ratio <= options.follow], apart, options.basins)
    chosen = tuple((sensor, *node) for node in (grid.lowest + nodes[picked]).tolist())
    lowest = (left == minimum_filter(left, size=3))[tuple(nodes.T)]
    away = np.linalg.norm(places[:, None] - places[picked], axis=2).min(axis=1, initial=np.inf)
    rest = np.flatnonzero(lowest & (away >= apart))
    if not len(rest):
        return StartCandidates(chosen, float("inf"), None)
    return StartCandidates(chosen, float(ratio[rest[0]]), places[rest[0]])


def spread_out(places: FloatArray, apart: float, most: int) -> list[int]:
    """Return at most so many rows, the first ones that keep a distance from those before.

    Places, shape (N, 3), and the distance ``apart`` are in metres.
    """
    picked: list[int] = []
    free = np.ones(len(places), dtype=np.bool_)
    while len(picked) < most and free.any():
        row = int(np.argmax(free))
        picked.append(row)
        free &= np.linalg.norm(places - places[row], axis=1) >= apart
    return picked


def distinct(basins: Sequence[Basin], apart: float) -> tuple[Basin, ...]:
    """Return basins that are apart, the best first."""
    kept: list[Basin] = []
    for basin in sorted(basins, key=lambda each: each.rms):
        if all(np.linalg.norm(basin.t - other.t) > apart for other in kept):
            kept.append(basin)
    return tuple(kept)
