"""What a solve would say of a drive, from poses and map alone: its graph, never optimised.

The graph stands at assumed sensors whose readings are what the map predicts, so that it is at its
optimum already. Rank test, weights and covariance are those of the solve, by the same code.
"""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions, fit_distortions, start_estimate
from l2m_gtsam.calibration.budget.unseen_warp import foretold_warp
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint import SensorSolution, joint_problem, sensor_solutions
from l2m_gtsam.calibration.priors import NO_PRIORS, Priors
from l2m_gtsam.calibration.uncertain_graph import (
    IndependentOptimum,
    UncertainDrive,
    UncertainProblem,
    starting_values,
)
from l2m_gtsam.calibration.uncertain_optimum import UncertainOptimum
from l2m_gtsam.calibration.view import QueryableMap, StandIns, View, glimpse, observe
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.solve.rank import Determinacy


@dataclass(frozen=True)
class Forecast:
    """What a drive would determine of ideal sensors.

    Attributes
    ----------
    view
        Poses at which a sensor would lie inside the map, with the readings it would give.
    solved
        Covariance and rank test of the sensors that have enough of them.
    uncertainty
        How the map's errors are counted.
    """

    view: View
    solved: tuple[SensorSolution, ...]
    uncertainty: Uncertainty


def forecast(
    readings: Readings,
    field_map: QueryableMap,
    t_lidar_mag: FloatArray,
    noise: float,
    options: OneKeyOptions,
    priors: Priors = NO_PRIORS,
) -> Forecast:
    """Return what a solve would say of sensors at assumed places, with C a rotation and H = 0.

    Parameters
    ----------
    readings
        Poses of S sensors; their field is not looked at.
    field_map
        The magnetic map.
    t_lidar_mag
        Assumed places of the sensors in the lidar frame in metres, shape (S, 3).
    noise
        Standard deviation of the sensors' noise in uT.
    options
        How the solve would go.
    priors
        What is known of the sensors beforehand; without a nominal rotation C = I.
    """
    every = np.full(len(t_lidar_mag), noise)
    start = replace(start_estimate(t_lidar_mag, options, priors), noise=every)
    view = observe(readings, field_map, start, options.min_readings)
    ideal = ideal_sensors(start, view, options)
    view = ideal.view
    if not view.sensors:
        return Forecast(view, (), options.uncertainty)
    return stated_at(view, field_map, ideal.estimate, options)


def stated_at(
    view: View, field_map: QueryableMap, estimate: Estimate, options: OneKeyOptions
) -> Forecast:
    """Return what the graph of a solve says at an estimate, which is not optimised.

    Parameters
    ----------
    view
        The readings that count, of one sensor or more.
    field_map
        The magnetic map.
    estimate
        Where the graph is weighed and linearised.
    options
        How the solve would go.
    """
    problem = joint_problem(view, field_map, estimate, options)
    if options.uncertainty is Uncertainty.FULL and isinstance(field_map, UncertainMap):
        # With the map's error, of which nothing is known yet, in the graph.
        tests = problem.determinacies
        near = IndependentOptimum(view, field_map, field_map, estimate, tests, options)
        drive = UncertainDrive.of(near)
        values = starting_values(estimate, view.sensors, drive.coverage)
        optimum = UncertainOptimum.at(UncertainProblem(drive, estimate), values)
        solved = optimum.solutions()
        if options.warp_m > 0:
            unseen = foretold_warp(optimum.informed_of_warp(), options.warp_m)
            solved = optimum.with_unseen(solved, unseen)
        return Forecast(view, solved, Uncertainty.FULL)
    return Forecast(view, sensor_solutions(problem, estimate), Uncertainty.INDEPENDENT)


def rank_tests(
    readings: Readings,
    field_map: QueryableMap,
    t_lidar_mag: FloatArray,
    noise: FloatArray,
    options: OneKeyOptions,
    priors: Priors = NO_PRIORS,
) -> dict[int, Determinacy]:
    """Return what a drive would determine of ideal sensors; parameters as of ``forecast``.

    Parameters
    ----------
    noise
        Standard deviation of each sensor's noise in uT, shape (S,).
    """
    start = replace(start_estimate(t_lidar_mag, options, priors), noise=noise)
    # A few readings' variance tells what is determined; the solve has asked for it.
    few, least = StandIns.of(readings, options.fewer_readings), options.min_readings
    view = glimpse(readings, few, field_map, start, t_lidar_mag, least)
    ideal = ideal_sensors(start, view, options)
    if not ideal.view.sensors:
        return {}
    return joint_problem(ideal.view, field_map, ideal.estimate, options).determinacies


@dataclass(frozen=True)
class Ideal:
    """Ideal sensors and the readings that they would give."""

    estimate: Estimate
    view: View


def ideal_sensors(start: Estimate, view: View, options: OneKeyOptions) -> Ideal:
    """Return sensors with C a rotation, H = 0 and the solve's own ridge.

    Parameters
    ----------
    start
        Where they are assumed, and their noise.
    view
        What the map says there.
    options
        How to solve.
    """
    # Their noise is given.
    options = options.model_copy(update={"sensor_noise_ut": float(start.noise.max())})
    field = np.einsum("nij,nj->ni", start.C()[view.readings.sensor], view.b_lidar)
    view = replace(view, readings=replace(view.readings, field=field))
    return Ideal(replace(start, ridge=fit_distortions(view, start, options).ridge), view)
