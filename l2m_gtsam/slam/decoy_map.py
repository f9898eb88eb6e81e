"""A map that is wrong for certain, and else like another: that map, turned about a place."""

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FieldSample, FloatArray

HALF_TURN = np.diag([-1.0, -1.0, 1.0])


class HalfTurned:
    """The field of a map as it is on the other side of a vertical axis, in the map's own axes.

    How strong it is, how it changes along a way and how well it is known stay about the same.

    Parameters
    ----------
    field_map
        The map.
    middle
        A point on the axis in metres, shape (3,).
    """

    def __init__(self, field_map: QueryableMap, middle: FloatArray) -> None:
        self._map, self._middle = field_map, middle

    def query(self, points: FloatArray) -> FieldSample:
        """Return the field there, points in metres of shape (N, 3)."""
        there = self._map.query((points - self._middle) @ HALF_TURN + self._middle)
        return FieldSample(there.field, there.gradient @ HALF_TURN, there.variance, there.inside)

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m there."""
        sample = self.query(points)
        return sample.field, sample.gradient
