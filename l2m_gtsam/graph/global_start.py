"""Where to start: the places that explain the readings best, without a guess.

The cost with C and H eliminated is looked at on a grid of places around the lidar, for all sensors
at once, on a map that costs nothing: the nearest reading of the survey. Its few best basins are
followed to their minima on the map itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field
from scipy.ndimage import minimum_filter

from l2m_gtsam.data import BoolArray, FloatArray, Readings
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.maps.nearest import NearestReadings
from l2m_gtsam.options import Options
from l2m_gtsam.results import FoundStart
from l2m_gtsam.solve.profile import (
    Linearisation,
    Prediction,
    Snapshots,
    linearised,
    misfits,
    snapshots_of,
)
from l2m_gtsam.solve.robust import RobustOptions, consistent
from l2m_gtsam.threads import in_threads

BATCH = 256  # candidates at a time
FIRST = 10  # poses that tell whether a candidate lies in the map at all
STEPS = 30  # of Gauss-Newton; four to eight are usual
SETTLED = 1e-3  # metres: the solve itself goes on from there
STRIDE = 1.9  # steps of the grid: places nearer to a better one are not followed
TINY = np.finfo(float).tiny
# A whitened residual this long is an outlier; from a start that is only near most are long.
LARGEST = RobustOptions().largest
FEWEST = 12  # readings inside: as many components as a distortion has parameters, three times


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


@dataclass(frozen=True)
class Basin:
    """A place that explains a sensor's readings better than those around it.

    Attributes
    ----------
    t
        In the lidar frame in metres, shape (3,).
    rms
        What it leaves of the readings that it explains best, per axis in uT.
    """

    t: FloatArray
    rms: float


def find_starts(
    readings: Readings, field_map: QueryableMap, centre: FloatArray, options: StartOptions
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
    """
    together = snapshots_of(readings, options.poses)
    found = starts_of(together, field_map, centre, options)
    for sensor in np.flatnonzero(~together.shared()).tolist():
        # A sensor that reads at other times than the rest is looked for by itself.
        rows = np.arange(len(readings))[readings.rows_of(sensor)]
        if len(rows):
            alone = snapshots_of(readings[rows], options.poses)
            found[sensor] = starts_of(alone, field_map, centre, options)[sensor]
    return found


def starts_of(
    snapshots: Snapshots, field_map: QueryableMap, centre: FloatArray, options: StartOptions
) -> list[FoundStart | None]:
    """Return where each sensor is from readings at common poses; see ``find_starts``."""
    grid = Candidates.around(centre, options)
    coarse = coarse_prediction(field_map, options)
    left = look(snapshots, coarse, grid, options)
    hopes = [hopes_of(grid, left[..., sensor], options) for sensor in range(left.shape[-1])]
    ends = descend(snapshots, fine_prediction(field_map, coarse), field_map, hopes, options)
    return [
        found_start(distinct(basins, options.apart), each)
        for basins, each in zip(ends, hopes, strict=True)
    ]


def found_start(basins: tuple[Basin, ...], hopes: "Hopes") -> FoundStart | None:
    """Return the best of a sensor's basins, best first, beside the second best."""
    if not basins:
        return None
    best, margin, runner_up = basins[0], hopes.margin, hopes.runner_up
    if len(basins) > 1 and (ratio := basins[1].rms / max(best.rms, TINY)) < margin:
        margin, runner_up = ratio, basins[1].t
    return FoundStart(best.t, float(margin), runner_up)


def coarse_prediction(field_map: QueryableMap, options: StartOptions) -> Prediction:
    """Return the nearest readings of a map that knows its own, and else the map."""
    if isinstance(field_map, Surveyed):
        return NearestReadings(field_map.readings, options.reach).predict

    def predict(points: FloatArray) -> tuple[FloatArray, BoolArray]:
        sample = field_map.query(points)
        return np.where(sample.inside[:, None], sample.field, 0.0), sample.inside

    return predict


def fine_prediction(field_map: QueryableMap, coarse: Prediction) -> Prediction:
    """Return the map itself where the coarse one knows something: its variance is not asked."""

    def predict(points: FloatArray) -> tuple[FloatArray, BoolArray]:
        _, inside = coarse(points)
        field = np.zeros((len(points), 3))
        field[inside], _ = field_map.field_and_gradient(points[inside])
        return field, inside

    return predict


@dataclass(frozen=True)
class Candidates:
    """Places on a cubic grid, of which those within a ball are looked at.

    Attributes
    ----------
    t
        All nodes in the lidar frame in metres, shape (n, n, n, 3).
    within
        Those in the ball, shape (n, n, n).
    """

    t: FloatArray
    within: BoolArray

    @classmethod
    def around(cls, centre: FloatArray, options: StartOptions) -> "Candidates":
        """Return the candidates about a middle."""
        half = int(np.ceil(options.search_radius / options.step))
        axis = options.step * np.arange(-half, half + 1)
        offset = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        within = np.linalg.norm(offset, axis=-1) <= options.search_radius
        return cls(centre + offset, within)


def look(
    snapshots: Snapshots, predict: Prediction, grid: Candidates, options: StartOptions
) -> FloatArray:
    """Return the misfits in uT of all nodes and sensors, shape (n, n, n, S).

    They are infinite where too few readings would lie in the map.
    """
    left = np.full((*grid.within.shape, snapshots.field.shape[1]), np.inf)
    nodes = np.argwhere(grid.within)
    _, inside = predict(snapshots.thinned(FIRST).places(grid.t[tuple(nodes.T)]).reshape(-1, 3))
    often = inside.reshape(len(nodes), -1).mean(axis=1) >= 0.5 * options.least_known
    nodes = nodes[often]

    def write(start: int) -> None:
        at = tuple(nodes[start : start + BATCH].T)
        part = misfits(snapshots, predict, grid.t[at], 1 - options.outliers)
        left[at] = np.where(part.known >= options.least_known, part.rms, np.inf)

    in_threads(write, range(0, len(nodes), BATCH))
    return left


@dataclass(frozen=True)
class Hopes:
    """Places to follow to their minima, for one sensor.

    Attributes
    ----------
    t
        In the lidar frame in metres, shape (B, 3).
    margin
        How many times more (root mean square) the best place that is not followed leaves on the
        grid than the best of all; infinite if there is none.
    runner_up
        That place in metres, shape (3,), if there is one.
    """

    t: FloatArray
    margin: float
    runner_up: FloatArray | None


def hopes_of(grid: Candidates, left: FloatArray, options: StartOptions) -> Hopes:
    """Return the places on the grid that could, seen finely, lead to the best.

    Beside minima these are nodes some steps from better ones: the coarse map knows little of
    heights, and its minimum may lie over or under the true one.
    """
    nodes = np.argwhere(np.isfinite(left))
    value = left[tuple(nodes.T)]
    order = np.argsort(value, kind="stable")
    places, ratio = grid.t[tuple(nodes[order].T)], value[order]
    ratio = ratio / max(ratio.min(initial=np.inf), TINY)
    picked = spread_out(places[ratio <= options.follow], STRIDE * options.step, options.basins)
    lowest = (left == minimum_filter(left, size=3))[tuple(nodes[order].T)]
    away = np.linalg.norm(places[:, None] - picked, axis=2).min(axis=1, initial=np.inf)
    rest = np.flatnonzero(lowest & (away >= STRIDE * options.step))
    if not len(rest):
        return Hopes(picked, float("inf"), None)
    return Hopes(picked, float(ratio[rest[0]]), places[rest[0]])


def spread_out(places: FloatArray, apart: float, most: int) -> FloatArray:
    """Return at most so many places, the first ones that keep a distance from those before."""
    picked: list[FloatArray] = []
    for place in places:
        if len(picked) == most:
            break
        if all(np.linalg.norm(place - other) >= apart for other in picked):
            picked.append(place)
    return np.array(picked).reshape(-1, 3)


def descend(
    snapshots: Snapshots,
    predict: Prediction,
    field_map: QueryableMap,
    hopes: list[Hopes],
    options: StartOptions,
) -> list[list[Basin]]:
    """Return the minima that the places of each sensor lead to.

    Gauss-Newton, all places in step: the map is asked once for all of them. Those about which too
    little is known lead nowhere.
    """
    descents = [
        Descent.begin(snapshots, sensor, t) for sensor, each in enumerate(hopes) for t in each.t
    ]
    if not descents:
        return [[] for _ in hopes]
    told = predict(np.concatenate([each.places for each in descents]))
    fields, inside = (split(part, descents) for part in told)
    descents = [each.starting(*at) for each, *at in zip(descents, fields, inside, strict=True)]
    active = descents = [each for each in descents if len(each.z) >= FEWEST]
    for _ in range(STEPS):
        if not active:
            break
        asked = field_map.field_and_gradient(np.concatenate([each.places for each in active]))
        answers = zip(*(split(part, active) for part in asked), strict=True)
        for each, (field, gradient) in zip(active, answers, strict=True):
            each.go_on(linearised(field, gradient, each.R, each.z), options.step)
        active = [each for each in active if np.linalg.norm(each.step) > SETTLED]
    rms = at_ends(snapshots, predict, descents, 1 - options.outliers)
    return [
        [Basin(d.t, left) for d, left in zip(descents, rms, strict=True) if d.sensor == s]
        for s in range(len(hopes))
    ]


def at_ends(
    snapshots: Snapshots, predict: Prediction, descents: list["Descent"], good: float
) -> list[float]:
    """Return what each descent's end leaves of its sensor's readings in uT."""
    if not descents:
        return []
    ends = misfits(snapshots, predict, np.stack([each.t for each in descents]), good)
    return [float(ends.rms[row, each.sensor]) for row, each in enumerate(descents)]


@dataclass
class Descent:
    """The way of one sensor from a place to a minimum of its cost.

    Attributes
    ----------
    sensor
        Index of the sensor.
    R, p, z
        Poses of the lidar in the map and readings in uT, shapes (K, 3, 3), (K, 3) and (K, 3).
    trial, step
        Where the cost is asked next, and how far that is from ``t``, shape (3,), metres.
    t, least
        The best place so far, shape (3,), and its cost in uT^2.
    """

    sensor: int
    R: FloatArray
    p: FloatArray
    z: FloatArray
    trial: FloatArray
    step: FloatArray
    t: FloatArray
    least: float = float("inf")

    @classmethod
    def begin(cls, snapshots: Snapshots, sensor: int, t: FloatArray) -> "Descent":
        """Return a descent from a place in metres, shape (3,)."""
        has = np.isfinite(snapshots.field[:, sensor]).all(axis=1)
        return cls(
            sensor,
            snapshots.R_map_lidar[has],
            snapshots.p_map_lidar[has],
            snapshots.field[has, sensor],
            trial=t,
            step=np.full(3, np.inf),
            t=t,
        )

    def starting(self, field: FloatArray, inside: BoolArray) -> "Descent":
        """Return the same on readings inside the map that are no outliers seen from here.

        ``field`` in uT, shape (K, 3), is that of the map at ``places``.
        """
        rows = np.flatnonzero(inside)
        b = np.einsum("kji,kj->ki", self.R[rows], field[rows])
        if len(rows) >= FEWEST:
            rows = rows[consistent(b, self.z[rows], np.zeros(len(rows)), LARGEST)]
        return replace(self, R=self.R[rows], p=self.p[rows], z=self.z[rows])

    @property
    def places(self) -> FloatArray:
        """Where the readings would have been taken in the map, metres, shape (K, 3)."""
        return np.asarray(self.R @ self.trial + self.p)

    def go_on(self, seen: Linearisation, longest: float) -> None:
        """Take the Gauss-Newton step, or a quarter of the last one where that led uphill."""
        cost = float(seen.residual @ seen.residual)
        if cost < self.least:
            self.t, self.least = self.trial, cost
            step = seen.step()
            self.step = step * min(1.0, longest / max(float(np.linalg.norm(step)), TINY))
        else:
            self.step = 0.25 * self.step
        self.trial = self.t + self.step


def split(values: Any, descents: Sequence[Descent]) -> list[Any]:
    """Return the rows of each descent."""
    return np.split(values, np.cumsum([len(each.z) for each in descents])[:-1])


def distinct(basins: list[Basin], apart: float) -> tuple[Basin, ...]:
    """Return basins that are apart, the best first."""
    kept: list[Basin] = []
    for basin in sorted(basins, key=lambda each: each.rms):
        if all(np.linalg.norm(basin.t - other.t) > apart for other in kept):
            kept.append(basin)
    return tuple(kept)
