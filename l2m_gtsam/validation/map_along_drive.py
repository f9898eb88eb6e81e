"""A map that is asked again and again along one drive, at places that hardly differ.

A change is followed in steps of centimetres, then of millimetres, and each sensor is tested beside
each displacement: nearly the same places are asked for a dozen times and more. What a map's errors
are over the places of a drive (which numbers, and how they are correlated) takes seconds, what they
do to a reading far less; the variance takes a hundred times as long as the field. Both change over
decimetres. The memory is that of one drive: a result must not depend on what was asked before it.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.calibration.coverage import MapErrors, UncertainMap
from l2m_gtsam.calibration.extent import TiledMap
from l2m_gtsam.calibration.view import REOBSERVE_M, QueryableMap
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, IntArray
from l2m_gtsam.maps.field_map import WrappedMap, unknown
from l2m_gtsam.maps.training import checked_points

# Metres between places whose errors are the same numbers. What these do to a reading is taken at
# its own place; what they do not explain there counts as its own error, so that nothing is lost.
NEAR_M = 0.03
MOST = 12  # sets of places whose errors are remembered: of 2500 weights each is 60 MB


@dataclass(frozen=True)
class KnownErrors:
    """Errors of a map over places.

    Attributes
    ----------
    tree
        The places, metres.
    tiles
        In which these lie, shape (T,), ascending.
    errors
        What the map says of them.
    """

    tree: cKDTree
    tiles: IntArray
    errors: MapErrors

    def covers(self, points: FloatArray, tiles: IntArray) -> bool:
        """Return whether other places, shape (N, 3), are near and in the same tiles, shape (T,)."""
        if not np.array_equal(tiles, self.tiles):
            return False
        away, _ = self.tree.query(points, distance_upper_bound=NEAR_M)
        return bool(np.isfinite(away).all())


@dataclass(frozen=True)
class KnownVariance:
    """The variance of a map at places.

    Attributes
    ----------
    tree
        The places, metres.
    variance
        Per axis of the map frame in uT^2, shape (N, 3).
    inside
        Whether the map has data there, shape (N,).
    """

    tree: cKDTree
    variance: FloatArray
    inside: BoolArray

    @classmethod
    def nowhere(cls) -> "KnownVariance":
        """Return that nothing is known."""
        return cls(cKDTree(np.empty((0, 3))), np.empty((0, 3)), np.empty(0, dtype=np.bool_))

    def __len__(self) -> int:
        return len(self.inside)

    def near(self, points: FloatArray) -> IntArray:
        """Return which place is the nearest to each point, their number N where none is near."""
        _, at = self.tree.query(points, distance_upper_bound=REOBSERVE_M)
        return np.asarray(at, dtype=np.int64)

    def extended(self, points: FloatArray, sample: FieldSample) -> "KnownVariance":
        """Return the same with more places, shape (M, 3), and what the map says there."""
        return KnownVariance(
            cKDTree(np.concatenate([self.tree.data, points])),
            np.concatenate([self.variance, sample.variance]),
            np.concatenate([self.inside, sample.inside]),
        )


class MapAlongDrive(WrappedMap):
    """A map that knows its errors, with a memory of them for one drive; else the map itself.

    Field and gradient are always those of the place itself.

    Parameters
    ----------
    field_map
        The map; see ``UncertainMap``.
    """

    def __init__(self, field_map: QueryableMap) -> None:
        super().__init__(field_map)
        self._errors: deque[KnownErrors] = deque(maxlen=MOST)
        self._variance = KnownVariance.nowhere()

    def __reduce__(self) -> tuple[type["MapAlongDrive"], tuple[QueryableMap]]:
        return MapAlongDrive, (self._map,)

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient of the map."""
        field, gradient = self._map.field_and_gradient(points)
        return field, gradient

    def errors_over(self, points: FloatArray, /) -> MapErrors:
        """Return the map's error over places, shape (N, 3) in metres: that of places near them.

        Of several that are known those of the fewest numbers are taken.
        """
        points = checked_points(points)
        tiles = self._tiles(points)
        near = [known.errors for known in self._errors if known.covers(points, tiles)]
        if near:
            return min(near, key=lambda each: sum(each.sizes().values()))
        errors: MapErrors = self._map.errors_over(points)
        self._errors.append(KnownErrors(cKDTree(points, copy_data=True), tiles, errors))
        return errors

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field and gradient of the map, and variance and its edge of places near by."""
        points, known = checked_points(points), self._variance
        at = known.near(points)
        new = at == len(known)
        if new.any():
            at[new] = len(known) + np.arange(new.sum())
            self._variance = known = known.extended(points[new], self._map.query(points[new]))
        sample, inside = unknown(len(points)), known.inside[at]
        sample.inside[:], sample.variance[:] = inside, known.variance[at]
        sample.field[inside], sample.gradient[inside] = self.field_and_gradient(points[inside])
        return sample

    def _tiles(self, points: FloatArray) -> IntArray:
        if not isinstance(self._map, TiledMap):
            return np.empty(0, dtype=np.int64)
        return np.unique(self._map.tile_of(points))


def along_drive(field_map: QueryableMap) -> QueryableMap:
    """Return a map for one drive, with a memory of its errors if it knows them."""
    return MapAlongDrive(field_map) if isinstance(field_map, UncertainMap) else field_map
