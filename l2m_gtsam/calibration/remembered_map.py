"""A map that is asked for no place twice.

What a map is worth at a place, its variance, costs a triangular solve with hundreds of weights:
forty times its field. A calibration comes back to the places of a drive, where sensors start and
where they were found, to test ranks, to compare models and to judge residuals. Within a solve one
step after the other asks for the field where the last one ended, of all readings or of those that
count: the last answer is remembered, too.
"""

from dataclasses import dataclass
from threading import Lock, local
from typing import Any

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FieldSample, FloatArray, IntArray

MOST = 500_000  # places that are remembered: 100 MB
VALUES = 15  # field, gradient and variance


@dataclass(frozen=True)
class LastFields:
    """Field (N, 3) in uT and gradient (N, 3, 3) in uT/m at points (N, 3) in metres."""

    points: FloatArray
    field: FloatArray
    gradient: FloatArray


NOTHING = LastFields(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))


class RememberedMap:
    """A map with a memory of the places that it was asked for; in all else the map itself.

    Parameters
    ----------
    field_map
        The map.
    """

    def __init__(self, field_map: QueryableMap) -> None:
        self._map = field_map
        self._lock = Lock()
        self._rows: dict[bytes, int] = {}
        self._values = np.empty((0, VALUES))
        self._inside = np.empty(0, dtype=np.bool_)
        self._own = local()  # what a thread asked last is no use to another, which would forget it

    def __getattr__(self, name: str) -> Any:
        if name == "_map":  # before there is one, as when another process unpacks it
            raise AttributeError(name)
        return getattr(self._map, name)

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
            sample = self._recalled(points)
        inside = sample.inside
        self._own.last = LastFields(points[inside], sample.field[inside], sample.gradient[inside])
        return sample

    def remember(self, points: FloatArray, sample: FieldSample) -> None:
        """Take what is known of places, shape (N, 3), from elsewhere for the map's own answer."""
        with self._lock:
            self._make_room(len(points))
            self._keep(_names(np.ascontiguousarray(points, dtype=np.float64)), sample)

    def _recalled(self, points: FloatArray) -> FieldSample:
        names = _names(points)
        self._make_room(len(points))
        fresh = np.array([name not in self._rows for name in names], dtype=np.bool_)
        if fresh.any():
            self._learn(points[fresh], [names[row] for row in np.flatnonzero(fresh)])
        at = np.array([self._rows[name] for name in names], dtype=np.int64)
        return self._sample(at)

    def _learn(self, points: FloatArray, names: list[bytes]) -> None:
        self._keep(names, self._map.query(points))

    def _keep(self, names: list[bytes], sample: FieldSample) -> None:
        parts = (sample.field, sample.gradient.reshape(-1, 9), sample.variance)
        first = len(self._values)
        self._rows.update((name, first + row) for row, name in enumerate(names))
        self._values = np.concatenate([self._values, np.hstack(parts)])
        self._inside = np.concatenate([self._inside, sample.inside])

    def _make_room(self, count: int) -> None:
        if len(self._rows) + count > MOST:
            self._rows, self._values, self._inside = {}, self._values[:0], self._inside[:0]

    def _sample(self, at: IntArray) -> FieldSample:
        values = self._values[at]
        gradient = values[:, 3:12].reshape(-1, 3, 3)
        return FieldSample(values[:, :3], gradient, values[:, 12:], self._inside[at])


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
    if not len(np.intersect1d(numbers, wanted_numbers)):  # as most often: the sensor has moved
        return np.full(len(wanted), -1)
    order = np.argsort(numbers)
    at = np.searchsorted(numbers, wanted_numbers, sorter=order)
    found = order[np.minimum(at, len(known) - 1)]
    return np.asarray(np.where((known[found] == wanted).all(axis=1), found, -1))


def _numbers(places: FloatArray) -> FloatArray:
    """Return a number for each place that hardly any other has, shape (N,)."""
    return np.asarray(places[:, 0] + np.pi * places[:, 1] + np.e * places[:, 2])
