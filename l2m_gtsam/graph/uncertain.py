"""The joint graph over an uncertain map: ``T(i)``, ``D(i)``, ``S(i)``, and errors that are shared.

The map's errors, ``M(b)``, are shared by readings near each other, in one pass or in many, of one
sensor or of all; those of the lidar's poses, ``P(k)``, by readings near each other in time; fields
that recorded numbers add, ``Q(i)``, by all readings of a sensor. As variables of the graph they
carry that into the marginals; counted as noise of each reading they would average out as they do
not in truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import (
    D,
    Q,
    map_weights_prior,
    pose_errors_prior,
    shared_error,
    uncertain_block_factor,
)
from l2m_gtsam.data import FloatArray
from l2m_gtsam.graph.alternation import OneKeyOptions
from l2m_gtsam.graph.calibration import Estimate, batch_readings, prior_graph
from l2m_gtsam.graph.contradictions import contradictions
from l2m_gtsam.graph.coverage import Coverage, UncertainMap, cover
from l2m_gtsam.graph.elimination import Eliminated, eliminate, weight_columns
from l2m_gtsam.graph.group_noise import group_noise
from l2m_gtsam.graph.joint import SensorSolution, with_infinities
from l2m_gtsam.graph.moving_fields import Correction, moving_fields
from l2m_gtsam.graph.view import QueryableMap, View
from l2m_gtsam.solve.figures import residual_figures
from l2m_gtsam.solve.noise import HALF, estimate_noise
from l2m_gtsam.solve.rank import Determinacy

MAX_ROUNDS = 6
STEPS = 2  # Gauss-Newton steps of a round; only products of C and shared errors are not linear
SETTLED_SIGMAS = 0.01


@dataclass(frozen=True)
class UncertainSolution:
    """An estimate and the solutions of its sensors.

    Attributes
    ----------
    estimate
        All sensors.
    solved
        Covariance and figures of each.
    settled
        Whether another round would repeat the last.
    """

    estimate: Estimate
    solved: tuple[SensorSolution, ...]
    settled: bool


def solve_uncertain(
    view: View,
    field_map: QueryableMap,
    errors: UncertainMap,
    near: Estimate,
    tests: Mapping[int, Determinacy],
    options: OneKeyOptions,
) -> UncertainSolution:
    """Finish a calibration with the map's error as part of the graph.

    Parameters
    ----------
    view
        The readings used.
    field_map, errors
        The map, and what it knows of its errors.
    near
        The optimum with independent errors.
    tests
        Rank test of each sensor.
    options
        How to solve.
    """
    coverage = cover(view, errors, near, options.pose_noise.correlation_s)
    moving = moving_fields(view.readings, options.moving_field_ut)
    coverage = replace(coverage, moving=moving)
    values = starting_values(near, view.sensors, coverage)
    estimate, settled = near, False
    for _ in range(MAX_ROUNDS):
        problem = UncertainProblem(view, field_map, coverage, estimate, tests)
        descent = problem.descend(values)
        values, after = descent.values, estimate.updated(descent.values, view.sensors)
        if options.sensor_noise_ut is None:
            after = replace(after, noise=problem.noise(values, estimate))
        settled = descent.last_step < SETTLED_SIGMAS and after.same_noise(estimate)
        estimate = after
        if settled:
            break
    return UncertainSolution(estimate, problem.solutions(values), settled)


def starting_values(estimate: Estimate, sensors: list[int], coverage: Coverage) -> gtsam.Values:
    """Return all variables of the graph, with no error of map or poses."""
    values = estimate.values(sensors)
    for key, size in coverage.sizes.items():
        values.insert(key, np.zeros(size))
    return values


@dataclass(frozen=True)
class Descent:
    """Values after some Gauss-Newton steps, and the last step's largest part in sigmas."""

    values: gtsam.Values
    last_step: float


class UncertainProblem:
    """The graph of one round: weights frozen at an estimate.

    Parameters
    ----------
    view, coverage
        Readings, and the map's error at them.
    field_map
        The map.
    estimate
        Where the weights are taken.
    tests
        Rank test of each sensor.
    """

    def __init__(
        self,
        view: View,
        field_map: QueryableMap,
        coverage: Coverage,
        estimate: Estimate,
        tests: Mapping[int, Determinacy],
    ) -> None:
        self._view, self._coverage, self._tests = view, coverage, tests
        self._priors = estimate.priors.among(view.sensors)
        self._batch = batch_readings(view.readings, field_map)
        self._noise = group_noise(view, field_map, coverage, estimate)
        self._graph = gtsam.NonlinearFactorGraph()
        for group, errors, W in zip(
            coverage.groups, self._noise.errors, self._noise.whitenings, strict=True
        ):
            self._graph.add(uncertain_block_factor(self._batch, group.rows, errors, W))
        self._graph.add(map_weights_prior(coverage.tiles, coverage.root_information))
        if coverage.knots is not None:
            self._graph.push_back(pose_errors_prior(coverage.knots.correlation.tolist()))
        self._graph.push_back(coverage.moving.prior())
        self._graph.push_back(prior_graph(estimate, {s: tests[s] for s in view.sensors}))

    def descend(self, values: gtsam.Values) -> Descent:
        """Take Gauss-Newton steps."""
        for _ in range(STEPS):
            system = self._eliminated(values)
            values = system.stepped(values, self._coverage.sizes)
        return Descent(values, max(system.sigmas(s) for s in self._view.sensors))

    def noise(self, values: gtsam.Values, estimate: Estimate) -> FloatArray:
        """Return the most likely noise of each sensor in uT, shape (S,)."""
        noise, residual = estimate.noise.copy(), self._residuals(values)
        system = self._eliminated(values)
        for s in self._view.sensors:
            rows, taken = self._batch.rows_of(s), self._taken(system, s)
            rows = rows[self._view.trust[rows] > HALF]
            noise[s] = estimate_noise(residual[rows], self._noise.rest[rows], taken)
        return noise

    def solutions(self, values: gtsam.Values) -> tuple[SensorSolution, ...]:
        """Return covariance and figures of every sensor."""
        system, residual = self._eliminated(values), self._residuals(values)
        missed = contradictions(self._priors, values, system.among)
        solutions = []
        for s in self._view.sensors:
            rows, taken = self._batch.rows_of(s), self._taken(system, s)
            solutions.append(
                SensorSolution(
                    sensor=s,
                    joint_covariance=with_infinities(system.covariance(s), self._tests[s]),
                    figures=residual_figures(residual[rows], self._noise.alone[rows], taken),
                    determinacy=self._tests[s],
                    remaining_sigmas=system.sigmas(s),
                    contradictions=tuple(each for each in missed if s in each.sensors),
                    moving=self._correction(s, system, values),
                    shared_root=system.shared_root(s)[:-1],
                )
            )
        return tuple(solutions)

    def _correction(
        self, sensor: int, system: Eliminated, values: gtsam.Values
    ) -> Correction | None:
        """Return what recorded numbers still add to a sensor's readings; none if it feels none."""
        moving, key = self._coverage.moving, Q(sensor)
        if sensor not in moving.scales:
            return None
        own = weight_columns(self._coverage.sizes)[key]
        covariance = system.covariance_of_weights[own, own]
        C = values.atVector(D(sensor))[:9].reshape(3, 3)
        return moving.correction(sensor, values.atVector(key), covariance, C)

    def _taken(self, system: Eliminated, sensor: int) -> float:
        """Return the degrees of freedom that the fit took of a sensor's readings."""
        return self._tests[sensor].free + system.taken(sensor)

    def _eliminated(self, values: gtsam.Values) -> Eliminated:
        linear = self._graph.linearize(values)
        return eliminate(linear, self._view.sensors, self._coverage.sizes)

    def _residuals(self, values: gtsam.Values) -> FloatArray:
        """Return ``e`` with the shared errors in it, uT, shape (N, 3)."""
        residual = np.empty((len(self._view.readings), 3))
        for group, errors in zip(self._coverage.groups, self._noise.errors, strict=True):
            base = self._batch.residuals(values, group.sensor).residual[group.rows]
            C = values.atVector(D(group.sensor))[:9].reshape(3, 3)
            residual[group.rows] = base + shared_error(errors, values) @ C.T
        return residual
