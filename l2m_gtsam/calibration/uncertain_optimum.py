"""What the graph of the last stage says at its optimum: covariances, figures and lasting errors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from l2m_factors import D, Q, U, W
from l2m_gtsam.calibration.budget.found import spread_of_H
from l2m_gtsam.calibration.budget.looked_for import LAGGING_S, processes
from l2m_gtsam.calibration.budget.processes import Process, ReadingPlaces, Warp
from l2m_gtsam.calibration.budget.search import ProcessInformation, process_information
from l2m_gtsam.calibration.budget.unseen_warp import UnseenWarp
from l2m_gtsam.calibration.cluster_robust import Scatter, scatters, unmodelled
from l2m_gtsam.calibration.coverage import Correction, Coverage
from l2m_gtsam.calibration.half_difference import (
    JUDGED,
    HalvedSensor,
    WhiteGroup,
    half_differences,
    second_half,
)
from l2m_gtsam.calibration.joint import SensorSolution, with_infinities
from l2m_gtsam.calibration.joint_information import JointInformation, Rows, columns_at, leverage
from l2m_gtsam.calibration.optimise import joint_covariance
from l2m_gtsam.calibration.parts_alone import ByParts, by_parts
from l2m_gtsam.calibration.priors import contradictions
from l2m_gtsam.calibration.sensor_columns import SENSOR, keys_of
from l2m_gtsam.calibration.stated_sizes import (
    NoiseBesidePoses,
    size_beside_noise,
    size_of_noise,
    size_of_shared,
)
from l2m_gtsam.calibration.uncertain_graph import UncertainProblem
from l2m_gtsam.calibration.variance_parts import variance_parts
from l2m_gtsam.calibration.view import View
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.error_budget import ErrorCause, StatedSize
from l2m_gtsam.solve.linear_algebra import covariance_root
from l2m_gtsam.solve.noise import HALF, estimate_noise, residual_figures


@dataclass(frozen=True)
class UncertainOptimum:
    """A graph at its optimum.

    Attributes
    ----------
    problem
        The graph.
    values
        The optimum.
    joint
        All variables together, linearised there or a step before.
    """

    problem: UncertainProblem
    values: gtsam.Values
    joint: JointInformation

    @classmethod
    def at(cls, problem: UncertainProblem, values: gtsam.Values) -> "UncertainOptimum":
        """Return a graph where it is linearised."""
        return cls(problem, values, problem.linearised(values))

    def noise(self) -> FloatArray:
        """Return the most likely noise of each sensor in uT, shape (S,)."""
        noise, ratio = self.problem.estimate.noise.copy(), self._view.readings.noise_ratio
        residual, rest = self._residual / ratio[:, None], self.problem.noise.rest / ratio**2
        for s in self._view.sensors:
            rows = self.problem.batch.rows_of(s)
            rows = rows[self._view.trust[rows] > HALF]
            noise[s] = estimate_noise(residual[rows], rest[rows], self._left[rows])
        return noise

    def solutions(self) -> tuple[SensorSolution, ...]:
        """Return covariance and figures of every sensor."""
        joint, problem, tests = self.joint, self.problem, self.problem.drive.tests
        sensors = tuple(self._view.sensors)
        system = joint_covariance(
            problem.graph.linearize(self.values), self.values, joint.of_system
        )

        def among(chosen: tuple[int, ...]) -> FloatArray:
            return system(chosen) + joint.loose_among(chosen)

        known = problem.estimate.priors.among(self._view.sensors)
        missed, every = contradictions(known, self.values, among), among(sensors)
        root = covariance_root(every, np.sqrt(np.diag(every)))
        solutions = []
        for row, s in enumerate(sensors):
            rows, own = problem.batch.rows_of(s), slice(SENSOR * row, SENSOR * (row + 1))
            white = np.einsum("nij,nj->ni", problem.noise.alone[rows], self._residual[rows])
            residual = problem.batch.residuals(self.values, s).residual[rows]
            solutions.append(
                SensorSolution(
                    sensor=s,
                    joint_covariance=with_infinities(every[own, own], tests[s]),
                    figures=residual_figures(residual, white, self._taken(s)),
                    determinacy=tests[s],
                    remaining_sigmas=joint.sigmas(s),
                    contradictions=tuple(each for each in missed if s in each.sensors),
                    moving=self._correction(s),
                    shared_root=root[own][:-1],
                )
            )
        return tuple(solutions)

    def informed(self) -> ProcessInformation:
        """Return what residuals say of all processes that are looked for; none is in the graph."""
        sensors, offset = self._view.sensors, self.problem.estimate.offset
        lagging = [sensor for sensor in sensors if offset[sensor] < -LAGGING_S]
        return self._informed(processes(self._places, sensors, lagging))

    def informed_of_warp(self) -> ProcessInformation:
        """Return what residuals say of a bend of the frame; none is in the graph."""
        return self._informed([Warp.of(self._places)])

    def with_unseen(
        self, solved: Sequence[SensorSolution], unseen: UnseenWarp
    ) -> tuple[SensorSolution, ...]:
        """Return solutions whose covariances hold a bend that is not in the graph."""
        return tuple(
            each.with_shared_error(ErrorCause.WARP, unseen.root[self._columns(each.sensor)])
            for each in solved
        )

    def scattered(self) -> dict[int, tuple[Scatter, ...]]:
        """Return how each sensor's parameters scatter over parts of the drive."""
        found = {}
        for s in self._view.sensors:
            own = [each for each in self._rows if each.sensor == s]
            found[s] = scatters(self._view.readings, own, self._columns(s), self.joint.every)
        return found

    def robust(
        self, solved: Sequence[SensorSolution], scattered: Mapping[int, tuple[Scatter, ...]]
    ) -> tuple[SensorSolution, ...]:
        """Return solutions whose covariances hold what the scatter of parts of the drive shows."""
        joint = self.joint
        stated = columns_at(joint.columns, [U()] if len(self._coverage.spread) else [])
        widened = []
        for each in solved:
            found, at = scattered[each.sensor], self._columns(each.sensor)
            excess = unmodelled(found, at, joint.every, len(self._view.sensors), stated)
            widened.append(each.widened(excess))
        return tuple(widened)

    def by_parts(self) -> tuple[ByParts, ...]:
        """Return what the scatter of parts of the drive says of each sensor."""
        found, estimate = [], self.problem.estimate.updated(self.values, self._view.sensors)
        for s in self._view.sensors:
            own = [each for each in self._groups if each.rows.sensor == s]
            at, vector = self._columns(s), estimate.vector(s)
            found.append(by_parts(s, vector, self._view.readings, own, at, self.joint.every))
        return tuple(found)

    def halved(self, solved: Sequence[SensorSolution]) -> tuple[SensorSolution, ...]:
        """Return solutions with what the halves of the drive differ by."""
        joint, later = self.joint, second_half(self._view.readings)
        halved = {
            s: HalvedSensor(self._columns(s)[:JUDGED], self._taken(s)) for s in self._view.sensors
        }
        found = half_differences(self._groups, later, halved, joint.every, joint.loose)
        return tuple(replace(each, halves=found[each.sensor]) for each in solved)

    def stated(self, noise_ut: float | None) -> tuple[StatedSize, ...]:
        """Return how large errors are of which sigmas were stated: of poses, and noise in uT."""
        names, found, coverage = self._view.readings.sensors, [], self._coverage
        if noise_ut is not None:
            sizes = self.noise()
            for s in self._view.sensors:
                freedom = 3 * len(self.problem.batch.rows_of(s)) - self._taken(s)
                found.append(size_of_noise(names[s], noise_ut, float(sizes[s]), freedom))
        if coverage.knots is not None and coverage.budget.poses is None:
            found.append(self._stated_poses())
        return tuple(found)

    def by_cause(self, solved: Sequence[SensorSolution]) -> tuple[SensorSolution, ...]:
        """Return solutions with what each cause has of their variances."""
        problem, sensors = self.problem, [each.sensor for each in solved]
        parts = variance_parts(self.joint, problem.drive.coverage, problem.noise, sensors)
        pairs = zip(solved, parts, strict=True)
        return tuple(replace(each, variances=own) for each, own in pairs)

    def wandering(self, solved: Sequence[SensorSolution]) -> tuple[SensorSolution, ...]:
        """Return solutions whose H is that of any moment of the drive."""
        found = []
        for each in solved:
            if wander := self._coverage.budget.wander(each.sensor):
                key = W(each.sensor)
                weights = self.values.atVector(key)
                each = each.with_spread_of_H(
                    spread_of_H(wander, weights, self.joint.covariance([key]))
                )
            found.append(each)
        return tuple(found)

    @property
    def _view(self) -> View:
        return self.problem.drive.view

    @cached_property
    def _places(self) -> ReadingPlaces:
        problem = self.problem
        return ReadingPlaces.of(self._view.readings, problem.drive.field_map, problem.estimate)

    def _informed(self, looked_for: Sequence[Process]) -> ProcessInformation:
        """Return what readings say of processes that are not in the graph."""
        white = self.problem.noise.whitenings
        return process_information(looked_for, self.joint, self._rows, white, self._places.C)

    @property
    def _coverage(self) -> Coverage:
        return self.problem.drive.coverage

    @cached_property
    def _residual(self) -> FloatArray:
        """``e`` with the shared errors in it, uT, shape (N, 3)."""
        return self.problem.residual(self.values)

    @cached_property
    def _left(self) -> FloatArray:
        """Share of the variance of each reading's residual that the fit leaves, shape (N,)."""
        left = np.ones(len(self._residual))
        for each in self._groups:
            left[each.rows.readings] = 1 - leverage(self.joint.every, each.rows, each.whitening)
        return left

    @cached_property
    def _rows(self) -> list[Rows]:
        """The white rows of all readings at the optimum."""
        joint = self.joint
        return [joint.after_step(each) for each in joint.rows if len(each.readings)]

    @property
    def _groups(self) -> list[WhiteGroup]:
        pairs = zip(self._rows, self.problem.noise.whitenings, strict=True)
        return [WhiteGroup(each, whitening) for each, whitening in pairs]

    def _columns(self, sensor: int) -> IntArray:
        """Return where a sensor's parameters stand among all variables, shape (16,)."""
        return columns_at(self.joint.columns, keys_of(sensor))

    def _taken(self, sensor: int) -> float:
        """Return the degrees of freedom that the fit took of a sensor's readings."""
        return self.problem.drive.tests[sensor].free + self.joint.taken(sensor)

    def _correction(self, sensor: int) -> Correction | None:
        """Return what recorded numbers still add to a sensor's readings; none if none act on it."""
        moving, key = self._coverage.moving, Q(sensor)
        if sensor not in moving.scales:
            return None
        C = self.values.atVector(D(sensor))[:9].reshape(3, 3)
        covariance = self.joint.covariance([key])
        return moving.correction(sensor, self.values.atVector(key), covariance, C)

    def _stated_poses(self) -> StatedSize:
        """Return how large errors of poses are of which sigmas were stated."""
        problem, sensors = self.problem, []
        for s in self._view.sensors:
            rows = problem.batch.rows_of(s)
            left, noise = float(problem.noise.of_poses[rows].mean()), problem.estimate.noise[s]
            counted = rows[self._view.trust[rows] > HALF]
            sensors.append(NoiseBesidePoses(self._residual[counted], float(noise), left))
        if size := size_beside_noise(sensors):
            return size
        keys = [key for key in self._coverage.sizes if chr(gtsam.symbolChr(key)) == "P"]
        at = columns_at(self.joint.columns, keys)
        weights = np.concatenate([self.values.atVector(key) for key in keys])
        prior = self._coverage.information[np.ix_(at, at)]
        return size_of_shared(ErrorCause.POSES, self.joint, at, prior, weights)
