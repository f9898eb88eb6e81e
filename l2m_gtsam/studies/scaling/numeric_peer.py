"""The peer of the scaling study: one least squares over t, C and H of all sensors together.

Derivatives are numeric, as where nobody wrote them down: each step evaluates all readings once
for every unknown, so that the work grows with the square of the number of sensors, and that of
the dense algebra with its cube.
"""

import numpy as np
from scipy.optimize import least_squares

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings

UNKNOWNS = 15  # of a sensor: t, C and H
MOST_STEPS = 30


def numeric_least_squares(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray
) -> FloatArray:
    """Return t, C row by row and H of S sensors, shape (S, 15).

    Parameters
    ----------
    readings
        Of all sensors.
    field_map
        The magnetic map.
    t_start
        Where to start in the lidar frame in metres, shape (S, 3); C starts from I, H from zero.
    """
    R, sensor = readings.R_map_lidar, readings.sensor

    def residuals(x: FloatArray) -> FloatArray:
        each = x.reshape(-1, UNKNOWNS)[sensor]
        places = np.einsum("nij,nj->ni", R, each[:, :3]) + readings.p_map_lidar
        field, _ = field_map.field_and_gradient(places)
        b_lidar = np.einsum("nji,nj->ni", R, field)
        C, H = each[:, 3:12].reshape(-1, 3, 3), each[:, 12:]
        return np.asarray(np.einsum("nij,nj->ni", C, b_lidar) + H - readings.field).ravel()

    ideal = np.tile(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), (len(t_start), 1))
    start = np.hstack([t_start, ideal])
    end = least_squares(residuals, start.ravel(), x_scale="jac", max_nfev=MOST_STEPS)
    return np.asarray(end.x.reshape(-1, UNKNOWNS))
