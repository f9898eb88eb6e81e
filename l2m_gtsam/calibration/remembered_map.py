"""A map that is asked for no place twice.

What a map is worth at a place, its variance, costs a triangular solve with hundreds of weights:
forty times its field. A calibration comes back to the places of a drive, where sensors start and
where they were found, to test ranks, to compare models and to judge residuals.
"""

from threading import Lock
from typing import Any

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FieldSample, FloatArray, IntArray

MOST = 500_000  # places that are remembered: 100 MB
VALUES = 15  # field, gradient and variance


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
        self._last = np.empty((0, 3)), (np.empty((0, 3)), np.empty((0, 3, 3)))

    def __getattr__(self, name: str) -> Any:
        if name == "_map":  # before there is one, as when another process unpacks it
            raise AttributeError(name)
        return getattr(self._map, name)

    def __reduce__(self) -> tuple[type["RememberedMap"], tuple[QueryableMap]]:
        return RememberedMap, (self._map,)

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient, to be read only.

        They cost little, and only the last answer is remembered: a round of the solve asks for
        residuals, for their derivatives and for what errors of the poses do at the same places.
        """
        asked, answer = self._last
        if not np.array_equal(points, asked):
            answer = self._map.field_and_gradient(points)
            for each in answer:
                each.setflags(write=False)
            self._last = points.copy(), answer
        return answer

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field, gradient, variance and whether the map has data there."""
        with self._lock:
            return self._recalled(np.ascontiguousarray(points, dtype=np.float64))

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
