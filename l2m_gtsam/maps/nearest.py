"""The coarsest map: everywhere the reading that is nearest."""

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.maps.training import TrainingSet


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
