"""The Cramer-Rao bound of a calibration: what no unbiased method can go below."""

import numpy as np

from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.errors import MapError
from l2m_gtsam.graph.alternation import OneKeyOptions
from l2m_gtsam.graph.calibration import Estimate
from l2m_gtsam.graph.coverage import UncertainMap, cover
from l2m_gtsam.graph.joint import joint_problem
from l2m_gtsam.graph.uncertain import UncertainProblem, starting_values
from l2m_gtsam.graph.view import QueryableMap, observe


def cramer_rao(
    readings: Readings,
    field_map: QueryableMap,
    sensor: KnownSensor,
    noise: float,
    options: OneKeyOptions,
) -> FloatArray:
    """Return the least covariance of (t, C, H, time offset) of one sensor, shape (16, 16).

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
    view = observe(readings, field_map, truth, options.min_readings)
    problem = joint_problem(view, field_map, truth, options)
    if not isinstance(field_map, UncertainMap):
        raise MapError("a bound needs a map that knows how its errors are correlated: harmonic")
    coverage = cover(view, field_map, truth, options.pose_noise.correlation_s)
    values = starting_values(truth, view.sensors, coverage)
    tests = problem.determinacies
    (solution,) = UncertainProblem(view, field_map, coverage, truth, tests).solutions(values)
    return solution.covariance
