"""Where sensors are looked for: places of a lattice, and the minima that the best lead to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.solve.profile import FieldPredictor, Linearisation, Snapshots, linearised, misfits
from l2m_gtsam.solve.robust import RobustOptions, consistent


@dataclass(frozen=True)
class Candidates:
    """Places on a cubic lattice, of which those within some balls are looked at.

    They are the lidar frame's multiples of a step: searches around different centres look at the
    same places.

    Attributes
    ----------
    step
        Metres.
    lowest
        The first node in steps, shape (3,).
    within
        Which nodes of a box are in a ball, shape (nx, ny, nz).
    """

    step: float
    lowest: IntArray
    within: BoolArray

    @classmethod
    def around(cls, centre: FloatArray, radius: float, step: float) -> "Candidates":
        """Return the candidates in the ball about a centre, shape (3,); all in metres."""
        lowest = np.floor((centre - radius) / step).astype(np.int64)
        highest = np.ceil((centre + radius) / step).astype(np.int64)
        box = cls(step, lowest, np.ones(highest - lowest + 1, dtype=np.bool_))
        away = np.linalg.norm(box.t(np.argwhere(box.within)) - centre, axis=1)
        return replace(box, within=(away <= radius).reshape(box.within.shape))

    @classmethod
    def union(cls, balls: Sequence["Candidates"]) -> "Candidates":
        """Return the candidates in any of some balls of one step."""
        lowest = np.min([ball.lowest for ball in balls], axis=0)
        ends = [ball.lowest + ball.within.shape for ball in balls]
        whole = cls(balls[0].step, lowest, np.zeros(np.max(ends, axis=0) - lowest, dtype=np.bool_))
        for ball in balls:
            whole.within[ball.slices_of(whole)] |= ball.within
        return whole

    def slices_of(self, whole: "Candidates") -> tuple[slice, slice, slice]:
        """Return where the box lies in a larger one."""
        x, y, z = (self.lowest - whole.lowest).tolist()
        nx, ny, nz = self.within.shape
        return slice(x, x + nx), slice(y, y + ny), slice(z, z + nz)

    def axes(self) -> list[FloatArray]:
        """Return the coordinates of the box's nodes along each axis in metres."""
        return [
            self.step * (first + np.arange(size))
            for first, size in zip(self.lowest, self.within.shape, strict=True)
        ]

    def t(self, nodes: IntArray) -> FloatArray:
        """Return nodes of the box, shape (N, 3), in the lidar frame in metres."""
        return np.asarray(self.step * (self.lowest + nodes))


class NearestReadings:
    """A map that costs nothing to make, to find the region where a better one is evaluated.

    Parameters
    ----------
    readings
        Readings in the map frame, metres and uT.
    reach
        A place further from all readings is not known, metres.
    """

    def __init__(self, readings: TrainingSet, reach: float) -> None:
        self._readings = readings
        self._reach = reach

    def predict(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the field in uT at points in metres, both of shape (N, 3), and where it is known.

        Where it is not known the field is zero.
        """
        away, row = self._readings.tree.query(points, distance_upper_bound=self._reach)
        known = np.isfinite(away)
        field = np.zeros((len(points), 3))
        field[known] = self._readings.field[np.asarray(row)[known]]
        return field, np.asarray(known)


ABREAST = 256  # descents at a time: the map is asked once for all of them, memory stays small
STEPS = 30  # of Gauss-Newton; four to eight are usual
SETTLED = 1e-3  # metres: the solve itself goes on from there
TINY = np.finfo(float).tiny
# A whitened residual this long is an outlier; from a start that is only near most are long.
LARGEST = RobustOptions().largest
FEWEST = 12  # readings inside: as many components as a distortion has parameters, three times


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


@dataclass(frozen=True)
class StartProblem:
    """What descents go by.

    Attributes
    ----------
    snapshots
        Readings of all sensors at common poses.
    predict
        The map where it is known.
    field_map
        The map with its gradient, also beyond.
    longest
        The longest step in metres.
    good
        Share of a sensor's readings that counts in what a minimum leaves.
    """

    snapshots: Snapshots
    predict: FieldPredictor
    field_map: QueryableMap
    longest: float
    good: float


def descend(problem: StartProblem, sensor: IntArray, t: FloatArray) -> list[Basin | None]:
    """Return the minimum that each place leads to; none where too little is known about it.

    Parameters
    ----------
    problem
        Readings and map.
    sensor
        Whose cost falls along each of D descents, shape (D,).
    t
        Where it begins in the lidar frame in metres, shape (D, 3).
    """
    basins: list[Basin | None] = []
    for start in range(0, len(t), ABREAST):
        at = slice(start, start + ABREAST)
        basins += refine_batch(problem, sensor[at], t[at])
    return basins


def refine_batch(problem: StartProblem, sensor: IntArray, t: FloatArray) -> list[Basin | None]:
    """Return the same, all places in step."""
    begun = [
        Descent.begin(problem.snapshots, *each) for each in zip(sensor.tolist(), t, strict=True)
    ]
    predicted = problem.predict(np.concatenate([each.places for each in begun]))
    fields, inside = (split(part, begun) for part in predicted)
    begun = [each.starting(*at) for each, *at in zip(begun, fields, inside, strict=True)]
    gauss_newton(problem, [each for each in begun if each.leads_on])
    ends = np.stack([each.t for each in begun])
    left = misfits(problem.snapshots, problem.predict, ends, problem.good).rms
    return [
        Basin(each.t, float(rms[each.sensor])) if each.leads_on else None
        for each, rms in zip(begun, left, strict=True)
    ]


def gauss_newton(problem: StartProblem, active: list["Descent"]) -> None:
    """Take Gauss-Newton steps until all descents have settled."""
    for _ in range(STEPS):
        if not active:
            break
        places = np.concatenate([each.places for each in active])
        asked = problem.field_map.field_and_gradient(places)
        answers = zip(*(split(part, active) for part in asked), strict=True)
        for each, (field, gradient) in zip(active, answers, strict=True):
            each.go_on(linearised(field, gradient, each.R, each.z), problem.longest)
        active = [each for each in active if np.linalg.norm(each.step) > SETTLED]


@dataclass
class Descent:
    """The path of one sensor from a place to a minimum of its cost.

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
    def leads_on(self) -> bool:
        """Whether enough is known about the place to go on from it."""
        return len(self.z) >= FEWEST

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
