"""What a localisation was begun with, in its saved state: another calibration or map is told."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.slam.drive import KnownSensors

MOST = 27  # places at which a map is compared
ABOUT_M = 3.0  # metres: these, of a map that does not state where it has data, about its origin
CALIBRATION_RTOL = 1e-6  # of numbers that were written to a file and read
FIELD_UT = 0.01  # uT: what the same map may have elsewhere, on another machine


@dataclass(frozen=True)
class BegunWith:
    """By what calibrations of S sensors and a map, or none, are known again.

    Attributes
    ----------
    names
        Of the sensors.
    sensors, variance
        t, C, H of them, and the variances of these, shapes (S, 15), m and uT.
    in_map
        Places in the map, m, and the field that it has there, uT, shapes (N, 3).
    """

    names: tuple[str, ...]
    sensors: FloatArray
    variance: FloatArray
    in_map: tuple[FloatArray, FloatArray] | None

    @classmethod
    def of(cls, sensors: KnownSensors, field_map: QueryableMap | None) -> "BegunWith":
        """Return what is to be kept of both."""
        variance = np.diagonal(sensors.covariance, axis1=1, axis2=2).copy()
        if field_map is None:
            return cls(sensors.names, sensors.vectors(), variance, None)
        places = _places(field_map)
        in_map = places, field_map.field_and_gradient(places)[0]
        return cls(sensors.names, sensors.vectors(), variance, in_map)

    def is_calibration(self, sensors: KnownSensors) -> bool:
        """Return whether sensors are these, but for digits that a file has not."""
        other = BegunWith.of(sensors, None)
        pairs = (self.sensors, other.sensors), (self.variance, other.variance)
        are_near = all(_are_near(*each, CALIBRATION_RTOL, 1e-12) for each in pairs)
        return self.names == other.names and are_near

    def is_map(self, field_map: QueryableMap | None) -> bool:
        """Return whether a map, or none, is this."""
        if field_map is None or self.in_map is None:
            return field_map is None and self.in_map is None
        places, saved = self.in_map
        return _are_near(saved, field_map.field_and_gradient(places)[0], 0.0, FIELD_UT)


def _are_near(one: FloatArray, other: FloatArray, rtol: float, atol: float) -> bool:
    return one.shape == other.shape and np.allclose(one, other, rtol, atol, equal_nan=True)


def _places(field_map: QueryableMap) -> FloatArray:
    if isinstance(field_map, Surveyed):
        points = field_map.readings.points
        few = np.linspace(0, len(points) - 1, min(len(points), MOST)).astype(np.int64)
        return np.asarray(points[few])
    axis = np.array([-ABOUT_M, 0.0, ABOUT_M])
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
