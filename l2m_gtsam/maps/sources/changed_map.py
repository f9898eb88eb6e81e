"""A map with sources that it did not have when it was surveyed."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from l2m_gtsam.data import FieldAndGradient, FieldSample, FloatArray, IntArray
from l2m_gtsam.maps.field_map import WrappedMap
from l2m_gtsam.maps.sources.found_sources import FoundSources
from l2m_gtsam.maps.sources.source import SourceShape

# Of the standard deviations that a search found: it rests on the readings of the graph itself, in
# which sources are variables; as a prior its result weighs a hundredth.
LOOSE = 10.0


class SurveyedField(Protocol):
    """What a map is asked for that sources are added to."""

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient."""

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field, gradient, variance and whether the map has data there."""


@dataclass(frozen=True)
class SourceErrors:
    """What sources that are not known exactly do to a field.

    Attributes
    ----------
    shapes
        The sources, K of them.
    root
        Of the covariance of their parameters, shape (9 K, q).
    """

    shapes: tuple[SourceShape, ...]
    root: FloatArray

    @classmethod
    def loose(cls, found: FoundSources) -> "SourceErrors":
        """Return errors that leave sources to the graph."""
        return cls(found.shapes, LOOSE * found.root)

    def features(self, points: FloatArray) -> FloatArray:
        """Return what a unit of each does at points, uT, shape (N, 3, q)."""
        J = [shape.derivatives(points) for shape in self.shapes]
        return np.asarray(np.concatenate(J, axis=2) @ self.root)


@dataclass(frozen=True)
class ChangedErrors:
    """The errors of a map and of sources that were added to it; see ``MapErrors``."""

    of_map: Any
    of_sources: SourceErrors

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all beta of the map."""
        return np.asarray(self.of_map.covariance)

    @property
    def spread(self) -> FloatArray:
        """Standard deviations of what the whole map has in common: the survey's, and sources'."""
        return np.append(self.of_map.spread, np.ones(self.of_sources.root.shape[1]))

    @property
    def shift(self) -> FloatArray:
        """How far a unit of each moves the map as a whole: sources do not."""
        return np.hstack([self.of_map.shift, np.zeros((3, self.of_sources.root.shape[1]))])

    def sizes(self) -> dict[int, int]:
        """Return the number of beta of each tile."""
        return dict(self.of_map.sizes())

    def owner(self, points: FloatArray) -> IntArray:
        """Return the tile whose beta act at each point."""
        return np.asarray(self.of_map.owner(points))

    def features(self, points: FloatArray, tile: int) -> FloatArray:
        """Return A of a tile at points, shape (N, 3, r)."""
        return np.asarray(self.of_map.features(points, tile))

    def common_features(self, points: FloatArray, tile: int) -> FloatArray:
        """Return what the common errors do to a tile at points, shape (N, 3, s)."""
        of_map = self.of_map.common_features(points, tile)
        return np.concatenate([of_map, self.of_sources.features(points)], axis=2)


class ChangedMap(WrappedMap):
    """A map and sources beside it; in all else the map itself.

    Parameters
    ----------
    field_map
        As it was surveyed; one that knows its errors.
    found
        What changed since.
    """

    def __init__(self, field_map: SurveyedField, found: FoundSources) -> None:
        super().__init__(field_map)
        self._found = found

    def __reduce__(self) -> tuple[type["ChangedMap"], tuple[SurveyedField, FoundSources]]:
        return ChangedMap, (self._map, self._found)

    def compile(self) -> "ChangedMap":
        """Return the same over the form of the map that is asked faster."""
        return ChangedMap(self._map.compile(), self._found)

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient of both."""
        field, gradient = self._map.field_and_gradient(points)
        return self._with_sources(points, field, gradient)

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field and gradient of both, the map's variance, and where it has data."""
        known = self._map.query(points)
        field, gradient = self._with_sources(points, known.field, known.gradient)
        return FieldSample(field, gradient, known.variance, known.inside)

    def errors_over(self, points: FloatArray, /) -> ChangedErrors:
        """Return the errors of both."""
        return ChangedErrors(self._map.errors_over(points), SourceErrors.loose(self._found))

    def _with_sources(
        self, points: FloatArray, field: FloatArray, gradient: FloatArray
    ) -> FieldAndGradient:
        for shape in self._found.shapes:
            b, G = shape.field_and_gradient(points)
            field, gradient = field + b, gradient + G
        return field, gradient
