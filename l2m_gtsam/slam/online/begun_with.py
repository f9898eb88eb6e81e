"""What a localisation was begun with, in its saved state: another calibration or map is told."""

import numpy as np
import numpy.typing as npt

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.online.packing import Arrays

MOST = 27  # places at which a map is compared
ABOUT_M = 3.0  # metres: these, of a map that does not state where it has data, about its origin
CALIBRATION_RTOL = 1e-6  # of numbers that were written to a file and read
FIELD_UT = 0.01  # uT: what the same map may have elsewhere, on another machine


def packed_sensors(sensors: KnownSensors) -> Arrays:
    """Return t, C, H of S sensors and the variances of these, shapes (S, 15), m and uT."""
    variance = np.diagonal(sensors.covariance, axis1=1, axis2=2).copy()
    return {"sensors": sensors.vectors(), "variance": variance}


def packed_map(field_map: QueryableMap) -> Arrays:
    """Return places in a map, m, and the field that it has there, uT, shapes (N, 3)."""
    places = _places(field_map)
    return {"places": places, "field": field_map.field_and_gradient(places)[0]}


def is_same_calibration(saved: Arrays, sensors: KnownSensors) -> bool:
    """Return whether sensors are those of a state, but for digits that a file has not."""
    own = packed_sensors(sensors)
    return all(_are_near(saved[name], own[name], CALIBRATION_RTOL, 1e-12) for name in own)


def is_same_map(saved: Arrays, field_map: QueryableMap | None) -> bool:
    """Return whether a map, or none, is that of a state."""
    if field_map is None or "places" not in saved:
        return field_map is None and "places" not in saved
    field = field_map.field_and_gradient(saved["places"])[0]
    return _are_near(saved["field"], field, 0.0, FIELD_UT)


def _are_near(one: npt.NDArray[np.float64], other: FloatArray, rtol: float, atol: float) -> bool:
    return one.shape == other.shape and np.allclose(one, other, rtol, atol, equal_nan=True)


def _places(field_map: QueryableMap) -> FloatArray:
    if isinstance(field_map, Surveyed):
        points = field_map.readings.points
        few = np.linspace(0, len(points) - 1, min(len(points), MOST)).astype(np.int64)
        return np.asarray(points[few])
    axis = np.array([-ABOUT_M, 0.0, ABOUT_M])
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
