"""The Cramer-Rao bound of a calibration: what no unbiased method can go below."""

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.forecast import stated_at
from l2m_gtsam.calibration.view import QueryableMap, observe
from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.errors import MapError
from l2m_gtsam.records.calibration import Uncertainty


def cramer_rao(
    readings: Readings,
    field_map: QueryableMap,
    sensor: KnownSensor,
    noise: float,
    options: OneKeyOptions,
) -> FloatArray:
    """Return the least covariance of (t, C, H) of one sensor, shape (15, 15).

    It is the inverse of the information at the truth, with the map's errors unknown, too, and
    their prior from the survey (the Bayesian bound of Van Trees).

    Parameters
    ----------
    readings
        Of the sensor.
    field_map
        The magnetic map, which has to know how its errors are correlated.
    sensor
        The truth.
    noise
        Standard deviation of the sensor's noise in uT.
    options
        Which of the readings enter.

    Raises
    ------
    MapError
        The map does not know how its errors are correlated.
    """
    none = np.zeros(1)
    truth = Estimate(
        sensor.t_lidar_mag[None],
        sensor.distortion.vector()[None],
        np.array([noise]),
        none,
        none,
    )
    return bound_at(readings, field_map, truth, options)[:-1, :-1]


def bound_at(
    readings: Readings, field_map: QueryableMap, truth: Estimate, options: OneKeyOptions
) -> FloatArray:
    """Return the least covariance of (t, C, H, time offset) of one sensor, shape (16, 16).

    Parameters
    ----------
    readings
        Of the sensor, with the poses that they have at its true time offset, as far as these are
        known: errors of poses are unknowns, too.
    field_map
        The magnetic map, which has to know how its errors are correlated.
    truth
        The sensor, without a ridge.
    options
        Which of the readings enter, and how long errors of poses last.

    Returns
    -------
    Infinite for what the data do not determine; NaN if too few readings lie inside the map.

    Raises
    ------
    MapError
        The map does not know how its errors are correlated.
    """
    if not isinstance(field_map, UncertainMap):
        raise MapError("a bound needs a map that knows how its errors are correlated: harmonic")
    view = observe(readings, field_map, truth, options.min_readings)
    if not view.sensors:
        return np.full((16, 16), np.nan)
    shared = options.model_copy(update={"uncertainty": Uncertainty.FULL})
    (solution,) = stated_at(view, field_map, truth, shared).solved
    return solution.joint_covariance
