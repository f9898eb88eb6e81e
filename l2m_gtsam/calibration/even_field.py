"""Whether readings show that the field varies: where they do not, they show no place either.

Sigmas are those of the map's gradient where the solve ended. In a field that is much the same
everywhere noise leads it anywhere, to where the map happens to be steeper, and sigmas are then
those of a place that nothing holds.
"""

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.closed_form import left_by_any
from l2m_gtsam.solve.noise import is_chance

AXES = 3
LIMIT = float(quantile(0.999, AXES))  # of what a place explains of noise, so many are below


def shows_no_place(readings: Readings, field_map: QueryableMap, t: FloatArray) -> bool:
    """Return whether a field that is the same everywhere explains readings as well as a place.

    It has to leave noise: where neighbours have much the same left the field varies, and the map is
    of another place.

    Parameters
    ----------
    readings
        Of one sensor, those that were used, in order of time.
    field_map
        The map.
    t
        Where the sensor was found in the lidar frame, metres, shape (3,).
    """
    R, p = readings.R_map_lidar, readings.p_map_lidar
    sample = field_map.query(R @ t + p)
    inside = sample.inside
    if not inside.any():
        return True
    field, z, R = sample.field[inside], readings.field[inside], R[inside]
    by_map = left_by_any(np.einsum("nji,nj->ni", R, field), z)
    left = left_by_any(np.einsum("nji,j->ni", R, field.mean(axis=0)), z)
    # Twice the logarithm of the likelihood ratio, with noise as what the map leaves.
    gain = (np.sum(left**2) - np.sum(by_map**2)) / np.mean(by_map**2)
    return bool(gain < LIMIT) and is_noise(left)


def is_noise(left: FloatArray) -> bool:
    """Return whether neighbours are no more alike than chance makes them, shape (N, 3)."""
    alike = np.sum(left[1:] * left[:-1]) / np.sum(left**2)
    return is_chance(float(alike), left.size)
