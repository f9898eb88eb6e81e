"""Sensors that the solve drives out of the map: they are judged where they started.

In a field that is much the same everywhere nothing holds a sensor's place, and in the map of
another place every place is as bad: steps grow until there is no map. What it says at the start is
then what can be known: C and H there, and what the rank test finds of t.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions, fit_distortions
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.joint import SensorSolution, joint_problem, robust_solutions
from l2m_gtsam.calibration.trust import GRADUATION, NOTHING, trusted
from l2m_gtsam.calibration.view import QueryableMap, View, observe
from l2m_gtsam.data import BoolArray, Readings
from l2m_gtsam.solve.closed_form import Method


@dataclass(frozen=True)
class Stayed:
    """Sensors where they started.

    Attributes
    ----------
    estimate
        All sensors, these with C, H and noise as they follow from the map there.
    solved
        Solutions of those that have enough readings inside the map there.
    rejected
        Which of all readings no distortion explains there, shape (N,).
    """

    estimate: Estimate
    solved: tuple[SensorSolution, ...]
    rejected: BoolArray


def stayed(
    sensors: Collection[int],
    readings: Readings,
    field_map: QueryableMap,
    estimate: Estimate,
    options: OneKeyOptions,
) -> Stayed:
    """Return sensors as they are where the estimate has them, each reading with its own errors.

    Parameters
    ----------
    sensors
        Which.
    readings
        All N.
    field_map
        The map.
    estimate
        All sensors, these where they started.
    options
        How to solve.
    """
    rejected = np.zeros(len(readings), dtype=np.bool_)
    others = frozenset(range(len(estimate.t))) - frozenset(sensors)
    view = without(observe(readings, field_map, estimate, options.min_readings), others)
    if not view.sensors:
        return Stayed(estimate, (), rejected)
    plain = by_least_squares(options)
    estimate = fit_distortions(view, estimate, plain)
    now = trusted(view, field_map, estimate, options, len(GRADUATION), None)
    rejected[view.rows] = now.weights <= NOTHING
    if not now.view.sensors:
        return Stayed(estimate, (), rejected)
    estimate = fit_distortions(now.view, estimate, plain)
    problem = joint_problem(now.view, field_map, estimate, options)
    return Stayed(estimate, robust_solutions(problem, estimate), rejected)


def by_least_squares(options: OneKeyOptions) -> OneKeyOptions:
    """Return options without errors of the map in C's columns.

    Where a component of the field hardly varies, those would be all that it varies by.
    """
    closed_form = options.closed_form.model_copy(update={"method": Method.OLS})
    return options.model_copy(update={"closed_form": closed_form})


def without(view: View, sensors: Collection[int]) -> View:
    """Return a view without the readings of some sensors; what lies inside the map stays."""
    keep = ~np.isin(view.readings.sensor, list(sensors))
    return view.select(keep, [each for each in view.sensors if each not in sensors])
