"""The graph of the last stage: readings, priors, and what they share, at weights of an estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import (
    D,
    Q,
    U,
    UncertainReadings,
    W,
    uncertain_block_factor,
    uncertain_reading_factor,
)
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.budget.found import spread_of_H
from l2m_gtsam.calibration.budget.looked_for import processes
from l2m_gtsam.calibration.budget.processes import ReadingPlaces
from l2m_gtsam.calibration.budget.search import Searched, felt, search
from l2m_gtsam.calibration.cluster_robust import Scatter, scatters, unmodelled
from l2m_gtsam.calibration.factor_graph import Estimate, FactorForm, batch_readings, prior_graph
from l2m_gtsam.calibration.group_noise import group_noise
from l2m_gtsam.calibration.half_difference import (
    JUDGED,
    HalvedSensor,
    WhiteGroup,
    half_differences,
    second_half,
)
from l2m_gtsam.calibration.joint import SensorSolution, with_infinities
from l2m_gtsam.calibration.joint_information import (
    JointInformation,
    Rows,
    columns_at,
    joint_information,
    rows_of_factors,
)
from l2m_gtsam.calibration.moving_fields import Correction
from l2m_gtsam.calibration.optimise import (
    TOLERANCE,
    Ending,
    LinearSolver,
    Optimised,
    joint_covariance,
    most_after_step,
    optimise,
    polish,
)
from l2m_gtsam.calibration.parts_alone import ByParts, by_parts
from l2m_gtsam.calibration.priors import contradictions
from l2m_gtsam.calibration.sensor_columns import SENSOR, columns_of, keys_of
from l2m_gtsam.calibration.stated_sizes import (
    NoiseBesidePoses,
    size_beside_noise,
    size_of_noise,
    size_of_shared,
)
from l2m_gtsam.calibration.uncertain_drive import UncertainDrive
from l2m_gtsam.calibration.variance_parts import PriorRows, variance_parts
from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.error_budget import ErrorCause, StatedSize
from l2m_gtsam.solve.linear_algebra import covariance_root
from l2m_gtsam.solve.noise import HALF, estimate_noise, residual_figures
from l2m_gtsam.solve.rank import Determinacy

# A Gauss-Newton step of such a length leaves less than a hundredth of a sigma: from 0.17 it left
# 0.0005 on a drive with 2,477 weights. It is taken with the information that is there for the
# degrees of freedom; a linearisation and an elimination by GTSAM would cost a second.
NEAR_SIGMAS = 0.3
# From an optimum with other weights a step of up to this leaves less than a tenth of it, which the
# next round takes: for all 2,496 variables together 6.8, 3.1 and 0.9 left 0.024, 0.015 and 0.014.
ROUND_SIGMAS = 0.6
# A round whose step is as short as this for all variables together may be the last.
THERE_SIGMAS = 1.0
NEARLY = 0.1  # smallest decrease of the error, as a share, after which a descent goes on to there
POLISHING_STEPS = 2  # each shortens what remains fourfold at least


@dataclass(frozen=True)
class Arrival:
    """Where a round ended.

    Attributes
    ----------
    values
        The optimum.
    joint
        All variables together, a step before it.
    ending
        How the optimisation ended.
    """

    values: gtsam.Values
    joint: JointInformation
    ending: Ending


class UncertainProblem:
    """The graph of one round: weights frozen at an estimate.

    Parameters
    ----------
    drive
        Readings and what they share.
    estimate
        Where the weights are taken.
    tests
        Rank test of each sensor.
    factors
        One factor for a group of readings or one for each; the mathematics is the same.
    """

    def __init__(
        self,
        drive: UncertainDrive,
        estimate: Estimate,
        tests: Mapping[int, Determinacy],
        factors: FactorForm,
    ) -> None:
        view, field_map, prior = drive.view, drive.field_map, drive.prior
        self._view, self._prior, self._tests = view, prior, tests
        self._field_map, self._estimate = field_map, estimate
        self._known = estimate.priors.among(view.sensors)
        self._batch = batch_readings(view.readings, field_map)
        self._noise = group_noise(view, field_map, prior.coverage, estimate)
        self._groups = [
            UncertainReadings(self._batch, group.rows, errors, W)
            for group, errors, W in zip(
                prior.coverage.groups, self._noise.errors, self._noise.whitenings, strict=True
            )
        ]
        self._sensor_priors = prior_graph(estimate, {s: tests[s] for s in view.sensors})
        self.graph = gtsam.NonlinearFactorGraph()
        for readings in self._groups:
            self.graph.push_back(_factors(readings, factors))
        self.graph.push_back(prior.graph)
        self.graph.push_back(self._sensor_priors)

    def arrive(
        self, values: gtsam.Values, options: OneKeyOptions, solver: LinearSolver, *, near: bool
    ) -> Arrival:
        """Go to the optimum, with the last step from the information of all variables.

        Parameters
        ----------
        values
            Where to start.
        options
            How to descend.
        solver
            Of the linear systems.
        near
            Whether the start is an optimum with other weights, or what one predicts, from where
            one step does.
        """
        if near:
            joint, ending = self.linearised(values), Ending.TOLERANCE
            came = joint.stepped(values)
            if joint.furthest(self._view.sensors) < ROUND_SIGMAS:
                return Arrival(came, joint, ending)
            if self.graph.error(came) > most_after_step(self.graph.error(values)):
                came = values
        else:
            descent = self.descend(values, options, solver, NEARLY)
            came, ending = descent.values, descent.ending
        joint = self.linearised(came)
        short = joint.furthest(self._view.sensors) < NEAR_SIGMAS
        if short or ending is Ending.SINGULAR:
            return Arrival(joint.stepped(came) if short else came, joint, ending)
        # Readings that cross from block to block of a map make steps in the error, which stop
        # a descent; the gradient does not see them.
        descent = self.descend(came, options, solver)
        last = self.polish(descent.values, POLISHING_STEPS, solver)
        ending = last.ending if last.ending is Ending.SINGULAR else descent.ending
        joint = self.linearised(last.values)
        close = joint.furthest(self._view.sensors) < NEAR_SIGMAS
        return Arrival(joint.stepped(last.values) if close else last.values, joint, ending)

    def descend(
        self,
        values: gtsam.Values,
        options: OneKeyOptions,
        solver: LinearSolver,
        tolerance: float = TOLERANCE,
    ) -> Optimised:
        """Minimise the cost."""
        optimizer, most = options.optimizer, options.joint_iterations
        return optimise(self.graph, values, optimizer, most, solver, tolerance)

    def polish(self, values: gtsam.Values, steps: int, solver: LinearSolver) -> Optimised:
        """Take Gauss-Newton steps that a descent leaves out, as too short or uphill."""
        return polish(self.graph, values, steps, solver)

    def linearised(self, values: gtsam.Values) -> JointInformation:
        """Return all variables together, linearised at some values."""
        columns = self._columns()
        rows = [
            Rows(
                each.sensor,
                columns_at(columns, each.keys),
                found.jacobian,
                found.residual,
                group.rows,
            )
            for each, group in zip(self._groups, self._prior.coverage.groups, strict=True)
            if (found := each.linearised(values))
        ]
        owner = {key: s for s in self._view.sensors for key in keys_of(s)}
        rows += rows_of_factors(self._sensor_priors.linearize(values), columns, owner)
        at = np.concatenate([values.atVector(key) for key in self._prior.coverage.sizes])
        joint = joint_information(columns, rows, self._prior.information, at)
        spread = self._prior.coverage.spread
        return joint.loosened(U(), spread) if len(spread) else joint

    def noise(
        self, joint: JointInformation, values: gtsam.Values, estimate: Estimate
    ) -> FloatArray:
        """Return the most likely noise of each sensor in uT, shape (S,)."""
        noise, residual = estimate.noise.copy(), self._residuals(values)
        for s in self._view.sensors:
            rows, taken = self._batch.rows_of(s), self._taken(joint, s)
            rows = rows[self._view.trust[rows] > HALF]
            noise[s] = estimate_noise(residual[rows], self._noise.rest[rows], taken)
        return noise

    def same_noise(self, one: Estimate, other: Estimate) -> bool:
        """Return whether no reading's standard deviation differs by more than 0.1 % for it.

        Beside errors of poses that last a moment, a sensor's noise may be as good as nothing.
        """
        for s in self._view.sensors:
            rest = float(self._noise.rest[self._batch.rows_of(s)].mean())
            if abs(np.log((one.noise[s] ** 2 + rest) / (other.noise[s] ** 2 + rest))) > 2e-3:
                return False
        return True

    def solutions(
        self, joint: JointInformation, values: gtsam.Values
    ) -> tuple[SensorSolution, ...]:
        """Return covariance and figures of every sensor."""
        residual, sensors = self._residuals(values), tuple(self._view.sensors)
        linear = self.graph.linearize(values)
        system = joint_covariance(linear, values, joint.of_system)

        def among(chosen: tuple[int, ...]) -> FloatArray:
            return system(chosen) + joint.loose_among(chosen)

        missed = contradictions(self._known, values, among)
        every = among(sensors)
        root = covariance_root(every, np.sqrt(np.diag(every)))
        solutions = []
        for row, s in enumerate(sensors):
            rows, own = self._batch.rows_of(s), slice(SENSOR * row, SENSOR * (row + 1))
            taken = self._taken(joint, s)
            solutions.append(
                SensorSolution(
                    sensor=s,
                    joint_covariance=with_infinities(every[own, own], self._tests[s]),
                    figures=residual_figures(residual[rows], self._noise.alone[rows], taken),
                    determinacy=self._tests[s],
                    remaining_sigmas=joint.sigmas(s),
                    contradictions=tuple(each for each in missed if s in each.sensors),
                    moving=self._correction(s, joint, values),
                    shared_root=root[own][:-1],
                )
            )
        return tuple(solutions)

    def searched(self, joint: JointInformation) -> Searched:
        """Return the processes that are not in the graph, and that its residuals show."""
        places = ReadingPlaces.of(self._view.readings, self._field_map, self._estimate)
        looked_for = processes(places, self._view.sensors)
        rows = [joint.after_step(each) for each in joint.rows if len(each.readings)]
        known = felt(looked_for, joint, rows, self._noise.whitenings, places.C)
        return search(known)

    def scattered(self, joint: JointInformation) -> dict[int, tuple[Scatter, ...]]:
        """Return how each sensor's parameters scatter over parts of the drive."""
        found = {}
        for s in self._view.sensors:
            rows, at = self._own_rows(joint, s), columns_at(joint.columns, keys_of(s))
            found[s] = scatters(self._view.readings, rows, at, joint.every)
        return found

    def robust(
        self,
        joint: JointInformation,
        solved: Sequence[SensorSolution],
        scattered: Mapping[int, tuple[Scatter, ...]],
    ) -> tuple[SensorSolution, ...]:
        """Return solutions whose covariances hold what the scatter of parts of the drive shows."""
        stated = columns_at(joint.columns, [U()] if len(self._prior.coverage.spread) else [])
        widened = []
        for each in solved:
            at = columns_at(joint.columns, keys_of(each.sensor))
            found = scattered[each.sensor]
            excess = unmodelled(found, at, joint.every, len(self._view.sensors), stated)
            widened.append(each.widened(excess))
        return tuple(widened)

    def by_parts(self, joint: JointInformation, estimate: Estimate) -> tuple[ByParts, ...]:
        """Return what the scatter of parts of the drive says of each sensor of an estimate."""
        groups, found = self._white_groups(joint), []
        for s in self._view.sensors:
            own = [each for each in groups if each.rows.sensor == s]
            at = columns_at(joint.columns, keys_of(s))
            vector = estimate.vector(s)
            found.append(by_parts(s, vector, self._view.readings, own, at, joint.every))
        return tuple(found)

    def _white_groups(self, joint: JointInformation) -> list[WhiteGroup]:
        """Return the white rows of all readings at the optimum."""
        rows = [joint.after_step(each) for each in joint.rows if len(each.readings)]
        pairs = zip(rows, self._noise.whitenings, strict=True)
        return [WhiteGroup(each, whitening) for each, whitening in pairs]

    def _own_rows(self, joint: JointInformation, sensor: int) -> list[Rows]:
        """Return the white rows of a sensor's readings at the optimum."""
        own = [each for each in joint.rows if each.sensor == sensor and len(each.readings)]
        return [joint.after_step(each) for each in own]

    def halved(
        self, joint: JointInformation, solved: Sequence[SensorSolution]
    ) -> tuple[SensorSolution, ...]:
        """Return solutions with what the halves of the drive differ by."""
        groups = self._white_groups(joint)
        later = second_half(self._view.readings)
        halved = {
            s: HalvedSensor(columns_at(joint.columns, keys_of(s))[:JUDGED], self._taken(joint, s))
            for s in self._view.sensors
        }
        found = half_differences(groups, later, halved, joint.every, joint.loose)
        return tuple(replace(each, halves=found[each.sensor]) for each in solved)

    def stated(
        self, joint: JointInformation, values: gtsam.Values, noise: float | None
    ) -> tuple[StatedSize, ...]:
        """Return how large errors are of which sigmas were stated: of poses, and noise in uT."""
        names, found = self._view.readings.sensors, []
        if noise is not None:
            sizes = self.noise(joint, values, self._estimate)
            for s in self._view.sensors:
                freedom = 3 * len(self._batch.rows_of(s)) - self._taken(joint, s)
                found.append(size_of_noise(names[s], noise, float(sizes[s]), freedom))
        coverage = self._prior.coverage
        if coverage.knots is not None and coverage.budget.poses is None:
            found.append(self._stated_poses(joint, values))
        return tuple(found)

    def _stated_poses(self, joint: JointInformation, values: gtsam.Values) -> StatedSize:
        """Return how large errors of poses are of which sigmas were stated."""
        residual, sensors = self._residuals(values), []
        for s in self._view.sensors:
            rows = self._batch.rows_of(s)
            left = float(self._noise.of_poses[rows].mean())
            noise = float(self._estimate.noise[s])
            counted = rows[self._view.trust[rows] > HALF]
            sensors.append(NoiseBesidePoses(residual[counted], noise, left))
        if size := size_beside_noise(sensors):
            return size
        keys = [key for key in self._prior.sizes if chr(gtsam.symbolChr(key)) == "P"]
        at = columns_at(joint.columns, keys)
        prior = self._prior.information[np.ix_(at, at)]
        weights = np.concatenate([values.atVector(key) for key in keys])
        return size_of_shared(ErrorCause.POSES, joint, at, prior, weights)

    def by_cause(
        self, joint: JointInformation, solved: Sequence[SensorSolution]
    ) -> tuple[SensorSolution, ...]:
        """Return solutions with what each cause has of their variances."""
        prior = PriorRows.of(self._prior.coverage.columns, self._prior.information)
        parts = variance_parts(joint, prior, self._noise, [each.sensor for each in solved])
        pairs = zip(solved, parts, strict=True)
        return tuple(replace(each, variances=own) for each, own in pairs)

    def wandering(
        self, joint: JointInformation, values: gtsam.Values, solved: Sequence[SensorSolution]
    ) -> tuple[SensorSolution, ...]:
        """Return solutions whose H is that of any moment of the drive."""
        budget, found = self._prior.coverage.budget, []
        for each in solved:
            if wander := budget.wander(each.sensor):
                key = W(each.sensor)
                spread = spread_of_H(wander, values.atVector(key), joint.covariance([key]))
                each = each.with_spread_of_H(spread)
            found.append(each)
        return tuple(found)

    def _correction(
        self, sensor: int, joint: JointInformation, values: gtsam.Values
    ) -> Correction | None:
        """Return what recorded numbers still add to a sensor's readings; none if it feels none."""
        moving, key = self._prior.coverage.moving, Q(sensor)
        if sensor not in moving.scales:
            return None
        C = values.atVector(D(sensor))[:9].reshape(3, 3)
        return moving.correction(sensor, values.atVector(key), joint.covariance([key]), C)

    def _taken(self, joint: JointInformation, sensor: int) -> float:
        """Return the degrees of freedom that the fit took of a sensor's readings."""
        return self._tests[sensor].free + joint.taken(sensor)

    def _columns(self) -> dict[int, slice]:
        """Return where each key's variables stand: weights first, then sensors."""
        weights = self._prior.coverage.columns
        first = len(self._prior.information)
        own = columns_of(tuple(self._view.sensors))
        return weights | {key: slice(first + at.start, first + at.stop) for key, at in own.items()}

    def _residuals(self, values: gtsam.Values) -> FloatArray:
        """Return ``e`` with the shared errors in it, uT, shape (N, 3)."""
        residual = np.empty((len(self._view.readings), 3))
        for group, readings in zip(self._prior.coverage.groups, self._groups, strict=True):
            residual[group.rows] = readings.residual(values)
        return residual


def _factors(readings: UncertainReadings, form: FactorForm) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a group of readings."""
    graph = gtsam.NonlinearFactorGraph()
    if form is FactorForm.BLOCK:
        graph.add(uncertain_block_factor(readings))
    else:
        for reading in range(len(readings)):
            graph.add(uncertain_reading_factor(readings, reading))
    return graph
