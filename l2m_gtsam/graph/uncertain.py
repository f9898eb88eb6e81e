"""The joint graph over an uncertain map: ``T(i)``, ``D(i)``, ``S(i)`` and the map's error ``M(b)``.

Map errors are shared by readings near each other, in one pass or in many, of one sensor or of
all. As variables of the graph they carry that into the marginals; counted as noise of each
reading they would average out as they do not in truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from l2m_factors import D, M, map_weights_prior, uncertain_block_factor
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.graph.alternation import OneKeyOptions
from l2m_gtsam.graph.calibration import (
    Estimate,
    batch_readings,
    prior_graph,
)
from l2m_gtsam.graph.elimination import Eliminated, eliminate
from l2m_gtsam.graph.joint import SensorSolution, with_infinities
from l2m_gtsam.graph.view import QueryableMap, View
from l2m_gtsam.solve.figures import residual_figures
from l2m_gtsam.solve.noise import (
    HALF,
    estimate_noise,
    map_covariance,
    reading_covariance,
    whitening,
)
from l2m_gtsam.solve.rank import Determinacy

MAX_ROUNDS = 6
STEPS = 2  # Gauss-Newton steps of a round; only the product of C and the map's error is not linear
SETTLED_SIGMAS = 0.01


class MapErrors(Protocol):
    """The error of a map over the places of a drive: ``A beta`` in each tile."""

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all beta, tile by tile, shape (K, K)."""
        ...

    def sizes(self) -> dict[int, int]:
        """Return the number of beta of each tile."""
        ...

    def owner(self, points: FloatArray, /) -> IntArray:
        """Return the tile whose beta act at each point, shape (N,)."""
        ...

    def features(self, points: FloatArray, tile: int, /) -> FloatArray:
        """Return A of a tile at points in uT, shape (N, 3, r)."""
        ...


@runtime_checkable
class UncertainMap(Protocol):
    """A map that knows how its errors are correlated."""

    def errors_over(self, points: FloatArray, /) -> MapErrors:
        """Return the map's error over places, shape (N, 3), in metres."""
        ...


@dataclass(frozen=True)
class Group:
    """Readings of one sensor in one tile.

    Attributes
    ----------
    sensor, tile
        Which.
    rows
        Of the view, shape (n,).
    features
        A in the map frame in uT, shape (n, 3, r).
    """

    sensor: int
    tile: int
    rows: IntArray
    features: FloatArray


@dataclass(frozen=True)
class Coverage:
    """The map's error at the readings of a view.

    Attributes
    ----------
    groups
        All readings, sensor by sensor and tile by tile.
    rest
        Variance of each reading that stays independent, per axis of the map in uT^2, (N, 3).
    sizes
        Number of weights of each tile.
    root_information
        Square root of the information of all weights, shape (K, K).
    """

    groups: tuple[Group, ...]
    rest: FloatArray
    sizes: dict[int, int]
    root_information: FloatArray


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
    coverage = cover(view, errors, near)
    values = near.values(view.sensors)
    for tile, size in coverage.sizes.items():
        values.insert(M(tile), np.zeros(size))
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


def cover(view: View, errors: UncertainMap, estimate: Estimate) -> Coverage:
    """Ask the map for its errors at the readings, where the estimate puts them."""
    readings = view.readings
    t = estimate.t[readings.sensor]
    x = np.einsum("nij,nj->ni", readings.R_map_lidar, t) + readings.p_map_lidar
    told = errors.errors_over(x)
    owner, rest, groups = told.owner(x), np.empty_like(x), []
    for tile in told.sizes():
        rows = np.flatnonzero(owner == tile)
        features = told.features(x[rows], tile)
        shared = np.einsum("nir,nir->ni", features, features)
        rest[rows] = np.maximum(view.map_variance[rows] - shared, 0.0)
        for sensor in np.unique(readings.sensor[rows]).tolist():
            own = readings.sensor[rows] == sensor
            groups.append(Group(sensor, tile, rows[own], features[own]))
    lower = np.linalg.cholesky(told.covariance)
    root = solve_triangular(lower, np.eye(len(lower)), lower=True)
    return Coverage(tuple(groups), rest, told.sizes(), root)


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
        sensor = view.readings.sensor
        share = map_covariance(estimate.C()[sensor], view.readings.R_map_lidar, coverage.rest)
        self._view, self._coverage, self._tests = view, coverage, tests
        self._rest = np.trace(share, axis1=1, axis2=2) / 3
        self._W = whitening(reading_covariance(estimate.noise[sensor], share, view.trust))
        self._batch = batch_readings(view.readings, field_map)
        self._graph = gtsam.NonlinearFactorGraph()
        for group in coverage.groups:
            self._graph.add(
                uncertain_block_factor(
                    self._batch, group.rows, group.tile, group.features, self._W[group.rows]
                )
            )
        self._graph.add(map_weights_prior(coverage.sizes, coverage.root_information))
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
            noise[s] = estimate_noise(residual[rows], self._rest[rows], taken)
        return noise

    def solutions(self, values: gtsam.Values) -> tuple[SensorSolution, ...]:
        """Return covariance and figures of every sensor."""
        system, residual = self._eliminated(values), self._residuals(values)
        solutions = []
        for s in self._view.sensors:
            rows, taken = self._batch.rows_of(s), self._taken(system, s)
            solutions.append(
                SensorSolution(
                    sensor=s,
                    covariance=with_infinities(system.covariance(s), self._tests[s]),
                    figures=residual_figures(residual[rows], self._W[rows], taken),
                    determinacy=self._tests[s],
                    remaining_sigmas=system.sigmas(s),
                )
            )
        return tuple(solutions)

    def _taken(self, system: Eliminated, sensor: int) -> float:
        """Return the degrees of freedom that the fit took of a sensor's readings."""
        return self._tests[sensor].free + system.taken(sensor)

    def _eliminated(self, values: gtsam.Values) -> Eliminated:
        linear = self._graph.linearize(values)
        return eliminate(linear, self._view.sensors, self._coverage.sizes)

    def _residuals(self, values: gtsam.Values) -> FloatArray:
        """Return ``e`` with the map's error in it, uT, shape (N, 3)."""
        residual = np.empty((len(self._view.readings), 3))
        for group in self._coverage.groups:
            base = self._batch.residuals(values, group.sensor).residual[group.rows]
            C = values.atVector(D(group.sensor))[:9].reshape(3, 3)
            in_lidar = self._batch.R_lidar_map(group.rows) @ group.features
            residual[group.rows] = base + in_lidar @ values.atVector(M(group.tile)) @ C.T
        return residual
