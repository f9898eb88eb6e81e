"""The baseline: Levenberg-Marquardt over t, C and H from where one guesses the sensor."""

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.factor_graph import Estimate, batch_readings, reading_graph
from l2m_gtsam.calibration.optimise import Optimizer, optimise
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import Distortion, FloatArray, Readings
from l2m_gtsam.solve.closed_form import fit_distortion
from l2m_gtsam.solve.noise import reading_covariance


def levenberg_marquardt(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    noise: float,
    options: OneKeyOptions,
) -> FloatArray:
    """Return where one optimisation of one sensor's joint graph ends, metres, shape (3,).

    C and H start from the closed form at the start. All readings take part, also those that a
    wrong start places outside of the map, which answers smoothly there: with only those inside
    many starts would leave nothing to optimise.

    Parameters
    ----------
    readings
        Of one sensor.
    field_map
        The magnetic map.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    noise
        Standard deviation of the readings in uT, which the baseline is told.
    options
        Closed form, factors, and the largest number of linearisations.
    """
    distortion = closed_form(readings, field_map, t_start, options)
    start = Estimate(t_start[None], distortion.vector()[None], np.array([noise]), *np.zeros((2, 1)))
    covariance = reading_covariance(np.full(len(readings), noise), np.zeros((len(readings), 3, 3)))
    graph = reading_graph(batch_readings(readings, field_map), covariance, options.factors)
    end = optimise(graph, start.values([0]), Optimizer.LM, options.joint_iterations)
    return np.asarray(start.updated(end.values, [0]).t[0])


def closed_form(
    readings: Readings, field_map: QueryableMap, t: FloatArray, options: OneKeyOptions
) -> Distortion:
    """Return C and H of one sensor at a place in the lidar frame in metres, shape (3,)."""
    R = readings.R_map_lidar
    field, _ = field_map.field_and_gradient(R @ t + readings.p_map_lidar)
    b_lidar = np.einsum("nji,nj->ni", R, field)
    weights = np.ones(len(readings))
    return fit_distortion(b_lidar, readings.field, weights, options.closed_form).distortion
