"""From places near the best to the minima that they lead to, on the map itself."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.solve.profile import FieldPredictor, Linearisation, Snapshots, linearised, misfits
from l2m_gtsam.solve.robust import RobustOptions, consistent

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
