"""The readings that a map covers at the current estimate, and what the map says about them.

What a map is worth at a place, its variance, costs a triangular solve with hundreds of weights:
forty times its field. A calibration comes back to the places of a drive, where sensors start and
where they were found, to test ranks, to compare models and to judge residuals. Within a solve one
step after the other asks for the field where the last one ended, of all readings or of those that
count: ``RememberedMap`` is asked for no place twice, and remembers the last answer, too.
"""

import math
from dataclasses import dataclass, replace
from threading import Lock, local
from typing import Protocol, runtime_checkable

import numpy as np

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, IntArray, Readings
from l2m_gtsam.maps.field_map import WrappedMap

# The map's errors change over decimetres: it is not asked for them again while all readings are as
# near to where it was, metres.
REOBSERVE_M = 5e-3
STAY = 0.5  # of the readings that lay inside the map: with fewer a sensor has left it


class QueryableMap(Protocol):
    """What the solve asks of a map: the factors' view of it, and a query that knows its edge."""

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient, smoothly extended beyond the data."""

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field, gradient, variance and whether the map has data there."""


@runtime_checkable
class Compilable(Protocol):
    """A map that has a faster form for solvers, equal to within far less than any noise."""

    def compile(self) -> QueryableMap:
        """Return that form."""


def for_solvers(field_map: QueryableMap) -> QueryableMap:
    """Return a map in its faster form, if it has one."""
    return field_map.compile() if isinstance(field_map, Compilable) else field_map


@dataclass(frozen=True)
class View:
    """Usable readings at an estimate.

    Attributes
    ----------
    readings
        The N readings of solvable sensors that lie inside the map.
    b_lidar
        Field that the map predicts there, in the lidar frame in uT, shape (N, 3).
    map_variance
        Its variance per axis of the map frame in uT^2, shape (N, 3).
    trust
        How far each counts, from 0 to 1, shape (N,).
    rows
        Which of all M readings these are, shape (N,).
    inside
        Which of all M readings lie inside the map, shape (M,).
    sensors
        Indices of the sensors that have enough readings inside the map.
    """

    readings: Readings
    b_lidar: FloatArray
    map_variance: FloatArray
    trust: FloatArray
    rows: IntArray
    inside: BoolArray
    sensors: list[int]

    def select(self, keep: BoolArray, sensors: list[int]) -> "View":
        """Return the part of the readings where ``keep``, shape (N,), is true, of some sensors."""
        return replace(
            self,
            readings=self.readings.select(keep),
            b_lidar=self.b_lidar[keep],
            map_variance=self.map_variance[keep],
            trust=self.trust[keep],
            rows=self.rows[keep],
            sensors=sensors,
        )


def places_of(readings: Readings, t: FloatArray) -> FloatArray:
    """Return where readings were taken in the map, metres, shape (N, 3).

    All that ask the map along a drive ask it at these very bits, so that it may remember them.

    Parameters
    ----------
    readings
        Of S sensors.
    t
        Where these are in the lidar frame in metres, shape (S, 3).
    """
    turned = np.einsum("nij,nj->ni", readings.R_map_lidar, t[readings.sensor])
    return np.asarray(turned + readings.p_map_lidar)


def observe(
    readings: Readings, field_map: QueryableMap, estimate: Estimate, min_readings: int
) -> View:
    """Ask the map at the estimated sensor positions, once for all sensors."""
    sample = field_map.query(places_of(readings, estimate.t))
    return _view(readings, sample, len(estimate.t), min_readings)


@dataclass(frozen=True)
class StandIns:
    """A few readings at whose places the map's variance is asked for instead of at all N.

    Attributes
    ----------
    few
        Those readings.
    nearest
        Which of them is the nearest to each of the N along its sensor's own, shape (N,).
    """

    few: Readings
    nearest: IntArray

    @classmethod
    def of(cls, readings: Readings, most: int) -> "StandIns":
        """Take at most so many readings of each sensor, two at least."""
        few, every = np.flatnonzero(spread(readings, most)), np.arange(len(readings))
        # The first and the last reading of each sensor are among them: both neighbours are its own.
        after = np.searchsorted(few, every)
        before = np.maximum(after - 1, 0)
        return cls(readings[few], np.where(every - few[before] < few[after] - every, before, after))

    def select(self, keep: BoolArray) -> "StandIns":
        """Return those of some of the readings, shape (N,)."""
        return StandIns(self.few, self.nearest[keep])

    def sample(
        self, readings: Readings, field_map: QueryableMap, t: FloatArray, t_few: FloatArray
    ) -> FieldSample:
        """Return what the map says of the readings.

        Parameters
        ----------
        readings
            N, of S sensors.
        field_map
            The map.
        t
            Where the field is taken, metres, shape (S, 3).
        t_few
            Where the variance is: there, near by, or where the map was asked before.
        """
        known = field_map.query(places_of(self.few, t_few))
        field, gradient = field_map.field_and_gradient(places_of(readings, t))
        at = self.nearest
        return FieldSample(field, gradient, known.variance[at], known.inside[at])


def glimpse(
    readings: Readings,
    stand_ins: StandIns,
    field_map: QueryableMap,
    estimate: Estimate,
    t_few: FloatArray,
    min_readings: int,
) -> View:
    """Return a view whose variance is that of a few readings, and the field its own.

    The variance is that where the few are with sensors at ``t_few``, metres, shape (S, 3).
    """
    sample = stand_ins.sample(readings, field_map, estimate.t, t_few)
    return _view(readings, sample, len(estimate.t), min_readings)


def spread(readings: Readings, most: int) -> BoolArray:
    """Return which are at most so many readings of each sensor, evenly over its own, shape (N,)."""
    keep = np.zeros(len(readings), dtype=np.bool_)
    for sensor in range(len(readings.sensors)):
        rows = np.arange(len(readings))[readings.rows_of(sensor)]
        count = min(most, len(rows))
        keep[rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]] = True
    return keep


def _view(readings: Readings, sample: FieldSample, sensors: int, min_readings: int) -> View:
    """Return the view of what the map says of all readings."""
    counts = np.bincount(readings.sensor[sample.inside], minlength=sensors)
    usable = counts >= min_readings
    keep = sample.inside & usable[readings.sensor]
    return View(
        readings=readings.select(keep),
        b_lidar=np.einsum("nji,nj->ni", readings.R_map_lidar[keep], sample.field[keep]),
        map_variance=sample.variance[keep],
        trust=np.ones(int(keep.sum())),
        rows=np.flatnonzero(keep),
        inside=sample.inside,
        sensors=[int(s) for s in np.flatnonzero(usable)],
    )


def inside_of_each(readings: Readings, view: View) -> IntArray:
    """Return how many of all M readings lie inside the map, sensor by sensor, shape (S,)."""
    return np.bincount(readings.sensor[view.inside], minlength=len(readings.sensors))


def has_left(readings: Readings, view: View, begun: IntArray) -> BoolArray:
    """Return which sensors have left the map since they had so many readings inside, shape (S,)."""
    return np.asarray(inside_of_each(readings, view) < STAY * begun)


def seen_from(view: View, field_map: QueryableMap, estimate: Estimate) -> View:
    """Return a view with the field of the estimated sensor positions, and the variance it had."""
    field, _ = field_map.field_and_gradient(places_of(view.readings, estimate.t))
    return replace(view, b_lidar=np.einsum("nji,nj->ni", view.readings.R_map_lidar, field))


MOST = 500_000  # places that are remembered: 100 MB
VALUES = 15  # field, gradient and variance


@dataclass(frozen=True)
class LastFields:
    """Field (N, 3) in uT and gradient (N, 3, 3) in uT/m at points (N, 3) in metres."""

    points: FloatArray
    field: FloatArray
    gradient: FloatArray


NOTHING = LastFields(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))


class RememberedMap(WrappedMap):
    """A map with a memory of the places that it was asked for; in all else the map itself.

    Parameters
    ----------
    field_map
        The map.
    """

    def __init__(self, field_map: QueryableMap) -> None:
        super().__init__(field_map)
        self._lock = Lock()
        self._rows: dict[bytes, int] = {}
        self._values = np.empty((0, VALUES))
        self._inside = np.empty(0, dtype=np.bool_)
        self._own = local()  # what a thread asked last is no use to another, which would forget it

    def __reduce__(self) -> tuple[type["RememberedMap"], tuple[QueryableMap]]:
        return RememberedMap, (self._map,)

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient; those of the last question or query are remembered."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        last: LastFields = getattr(self._own, "last", NOTHING)
        at = rows_among(last.points, points)
        known = at >= 0
        if known.all():
            return last.field[at], last.gradient[at]
        field, gradient = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        field[known], gradient[known] = last.field[at[known]], last.gradient[at[known]]
        field[~known], gradient[~known] = self._map.field_and_gradient(points[~known])
        self._own.last = LastFields(points.copy(), field.copy(), gradient.copy())
        return field, gradient

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field, gradient, variance and whether the map has data there."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        with self._lock:
            sample = self._recalled(points, _names(points))
        inside = sample.inside
        self._own.last = LastFields(points[inside], sample.field[inside], sample.gradient[inside])
        return sample

    def remember(self, points: FloatArray, sample: FieldSample) -> None:
        """Take what is known of places, shape (N, 3), from elsewhere for the map's own answer."""
        with self._lock:
            self._make_room(len(points))
            self._keep(_names(np.ascontiguousarray(points, dtype=np.float64)), sample)

    def _recalled(self, points: FloatArray, names: list[bytes]) -> FieldSample:
        self._make_room(len(points))
        fresh = np.array([name not in self._rows for name in names], dtype=np.bool_)
        if fresh.any():
            new = [names[row] for row in np.flatnonzero(fresh)]
            self._keep(new, self._map.query(points[fresh]))
        at = np.array([self._rows[name] for name in names], dtype=np.int64)
        values = self._values[at]
        gradient = values[:, 3:12].reshape(-1, 3, 3)
        return FieldSample(values[:, :3], gradient, values[:, 12:], self._inside[at])

    def _keep(self, names: list[bytes], sample: FieldSample) -> None:
        parts = (sample.field, sample.gradient.reshape(-1, 9), sample.variance)
        first = len(self._values)
        self._rows.update((name, first + row) for row, name in enumerate(names))
        self._values = np.concatenate([self._values, np.hstack(parts)])
        self._inside = np.concatenate([self._inside, sample.inside])

    def _make_room(self, count: int) -> None:
        if len(self._rows) + count > MOST:
            self._rows, self._values, self._inside = {}, self._values[:0], self._inside[:0]


def _names(points: FloatArray) -> list[bytes]:
    """Return the bits of each point."""
    return points.view(f"V{points.itemsize * points.shape[1]}").ravel().tolist()


def remembered(field_map: QueryableMap) -> RememberedMap:
    """Return a map with a memory; the map itself if it has one."""
    return field_map if isinstance(field_map, RememberedMap) else RememberedMap(field_map)


def rows_among(known: FloatArray, wanted: FloatArray) -> IntArray:
    """Return in which row of known places each wanted one is, -1 where in none, shape (M,).

    Parameters
    ----------
    known, wanted
        Places, shapes (N, 3) and (M, 3); equal to the last bit or not at all.
    """
    if np.array_equal(known, wanted):
        return np.arange(len(known))
    numbers, wanted_numbers = _numbers(known), _numbers(wanted)
    together = np.sort(np.concatenate([numbers, wanted_numbers]))
    if not len(known) or not (together[1:] == together[:-1]).any():  # as most often: all moved
        return np.full(len(wanted), -1)
    order = np.argsort(numbers)
    at = np.searchsorted(numbers, wanted_numbers, sorter=order)
    found = order[np.minimum(at, len(known) - 1)]
    return np.asarray(np.where((known[found] == wanted).all(axis=1), found, -1))


def _numbers(places: FloatArray) -> FloatArray:
    """Return a number for each place that hardly any other has, shape (N,)."""
    return np.asarray(places[:, 0] + np.pi * places[:, 1] + math.e * places[:, 2])
