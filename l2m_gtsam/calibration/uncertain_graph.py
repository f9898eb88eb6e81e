"""The graph of the last stage: readings, the map, priors, and the errors that readings share.

What all rounds have in common is an `UncertainDrive`; each has a graph at weights of its own.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import U, UncertainReadings, uncertain_block_factor, uncertain_reading_factor
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND, Budget
from l2m_gtsam.calibration.coverage import POSE, Coverage, UncertainMap, cover, moving_fields
from l2m_gtsam.calibration.factor_graph import Estimate, FactorForm, batch_readings, prior_graph
from l2m_gtsam.calibration.group_noise import group_noise
from l2m_gtsam.calibration.joint_information import (
    JointInformation,
    Rows,
    columns_at,
    joint_information,
    rows_of_factors,
)
from l2m_gtsam.calibration.optimise import (
    NEARLY,
    TOLERANCE,
    Ending,
    LinearSolver,
    Optimised,
    most_after_step,
    optimise,
    polish,
)
from l2m_gtsam.calibration.pose_errors import at_likely_poses
from l2m_gtsam.calibration.sensor_columns import columns_of, keys_of
from l2m_gtsam.calibration.stated_sizes import take_all_noise
from l2m_gtsam.calibration.view import QueryableMap, View
from l2m_gtsam.data import FloatArray, Readings
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
POLISHING_STEPS = 2  # each shortens what remains fourfold at least


def starting_values(estimate: Estimate, sensors: list[int], coverage: Coverage) -> gtsam.Values:
    """Return all variables of the graph, with no error of map or poses."""
    values = estimate.values(sensors)
    for key, size in coverage.sizes.items():
        values.insert(key, np.zeros(size))
    return values


@dataclass(frozen=True)
class IndependentOptimum:
    """What the last graph goes on from: the optimum with independent errors.

    Attributes
    ----------
    view
        The readings used.
    field_map, errors
        The map, and what it knows of its errors.
    estimate
        All sensors.
    tests
        Rank test of each sensor.
    options
        How to solve.
    """

    view: View
    field_map: QueryableMap
    errors: UncertainMap
    estimate: Estimate
    tests: dict[int, Determinacy]
    options: OneKeyOptions


@dataclass(frozen=True)
class UncertainDrive:
    """What all rounds have in common: readings, the map, and the errors that readings share.

    Attributes
    ----------
    view, field_map, tests, options
        As of ``IndependentOptimum``.
    coverage
        The errors that readings share.
    """

    view: View
    field_map: QueryableMap
    tests: dict[int, Determinacy]
    options: OneKeyOptions
    coverage: Coverage

    @property
    def budget(self) -> Budget:
        """Processes that its graph has."""
        return self.coverage.budget

    @classmethod
    def of(cls, near: IndependentOptimum, budget: Budget = NOTHING_FOUND) -> "UncertainDrive":
        """Return what readings share where an estimate puts them."""
        options, view = near.options, replace(near.view, readings=budget.on(near.view.readings))
        lasting_s = budget.lasting(options.pose_noise.lasting_s)
        coverage = cover(view, near.errors, near.estimate, lasting_s)
        moving = moving_fields(view.readings, options.moving_field_ut)
        coverage = replace(coverage, moving=moving, budget=budget)
        return cls(view, near.field_map, near.tests, options, coverage)

    def beside(self, budget: Budget) -> "UncertainDrive":
        """Return the same with processes that are no errors of poses, and the map as it was asked.

        Errors of poses cut a drive at other knots, for which the map has to be asked again.
        """
        return replace(self, coverage=replace(self.coverage, budget=budget))


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
    held_at
        Where directions are held that nothing determines; at the estimate if that is not given.
    readings
        Those of the drive where their poses are likely; as they are if that is not known.

    Attributes
    ----------
    drive, estimate
        As given.
    batch
        The readings as factors have them.
    groups
        The same by sensor and pass, with the errors that they share.
    noise
        How large errors are that readings do not share.
    graph
        Of GTSAM.
    """

    def __init__(
        self,
        drive: UncertainDrive,
        estimate: Estimate,
        held_at: Estimate | None = None,
        readings: Readings | None = None,
    ) -> None:
        view, field_map, coverage = drive.view, drive.field_map, drive.coverage
        view = view if readings is None else replace(view, readings=readings)
        self.drive, self.estimate = drive, estimate
        self.batch = batch_readings(view.readings, field_map)
        self.noise = group_noise(view, field_map, coverage, estimate)
        self.groups = [
            UncertainReadings(self.batch, group.rows, errors, W)
            for group, errors, W in zip(
                coverage.groups, self.noise.errors, self.noise.whitenings, strict=True
            )
        ]
        own = {s: drive.tests[s] for s in view.sensors}
        self._sensor_priors = prior_graph(estimate if held_at is None else held_at, own)
        self.graph = gtsam.NonlinearFactorGraph()
        for group in self.groups:
            self.graph.push_back(_factors(group, drive.options.factors))
        self.graph.push_back(drive.coverage.prior)
        self.graph.push_back(self._sensor_priors)

    def arrive(self, values: gtsam.Values, solver: LinearSolver, *, near: bool) -> Arrival:
        """Go to the optimum, with the last step from the information of all variables.

        Parameters
        ----------
        values
            Where to start.
        solver
            Of the linear systems.
        near
            Whether the start is an optimum with other weights, or what one predicts, from where
            one step does.
        """
        if near:
            joint, ending = self.linearised(values), Ending.TOLERANCE
            came = joint.stepped(values)
            if joint.furthest(self.drive.view.sensors) < ROUND_SIGMAS:
                return Arrival(came, joint, ending)
            if self.graph.error(came) > most_after_step(self.graph.error(values)):
                came = values
        else:
            descent = self.descend(values, solver, NEARLY)
            came, ending = descent.values, descent.ending
        joint = self.linearised(came)
        short = joint.furthest(self.drive.view.sensors) < NEAR_SIGMAS
        if short or ending is Ending.SINGULAR:
            return Arrival(joint.stepped(came) if short else came, joint, ending)
        # Readings that cross from block to block of a map make steps in the error, which stop
        # a descent; the gradient does not see them.
        descent = self.descend(came, solver)
        last = self.polish(descent.values, POLISHING_STEPS, solver)
        ending = last.ending if last.ending is Ending.SINGULAR else descent.ending
        joint = self.linearised(last.values)
        close = joint.furthest(self.drive.view.sensors) < NEAR_SIGMAS
        return Arrival(joint.stepped(last.values) if close else last.values, joint, ending)

    def descend(
        self, values: gtsam.Values, solver: LinearSolver, tolerance: float = TOLERANCE
    ) -> Optimised:
        """Minimise the cost."""
        optimizer, most = self.drive.options.optimizer, self.drive.options.joint_iterations
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
            for each, group in zip(self.groups, self.drive.coverage.groups, strict=True)
            if (found := each.linearised(values))
        ]
        owner = {key: s for s in self.drive.view.sensors for key in keys_of(s)}
        rows += rows_of_factors(self._sensor_priors.linearize(values), columns, owner)
        at = np.concatenate([values.atVector(key) for key in self.drive.coverage.sizes])
        joint = joint_information(columns, rows, self.drive.coverage.information, at)
        spread = self.drive.coverage.spread
        return joint.loosened(U(), spread) if len(spread) else joint

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return ``e`` with the shared errors in it, uT, shape (N, 3)."""
        residual = np.empty((len(self.drive.view.readings), 3))
        for group, readings in zip(self.drive.coverage.groups, self.groups, strict=True):
            residual[group.rows] = readings.residual(values)
        return residual

    def at_likely_poses(self, values: gtsam.Values) -> Readings:
        """Return the drive's readings where their poses are likely, which knots say in part.

        They are as measured where poses are exact; where errors last, which are variables: a
        correction by what knots leave of them is quadratic in residuals that hang together, and
        scatters more than it mends; and where errors of a stated size take the place of all noise:
        then these are too large, and what they would correct is noise.
        """
        readings, pose, estimate = self.drive.view.readings, self.noise.pose, self.estimate
        if pose is None or not pose.knots.of_each_pose:
            return readings
        if take_all_noise(estimate.noise[self.drive.view.sensors]):
            return readings
        errors, residual = np.empty((len(readings), POSE)), self.residual(values)
        groups = self.drive.coverage.groups
        for group, W in zip(groups, self.noise.whitenings, strict=True):
            weighted = W.T @ (W @ residual[group.rows].ravel())
            errors[group.rows] = pose.likely(group, weighted.reshape(-1, 3))
        of_each = estimate.C()[readings.sensor]
        return at_likely_poses(readings, pose.root, errors, pose.features, of_each)

    def same_noise(self, one: Estimate, other: Estimate, sensor: int) -> bool:
        """Return whether no reading's standard deviation differs by more than 0.1 % for a sensor's.

        Beside errors of poses that last a moment, a sensor's noise may be as good as nothing.
        """
        rest = float(self.noise.rest[self.batch.rows_of(sensor)].mean())
        first, second = (each.noise[sensor] ** 2 + rest for each in (one, other))
        return bool(abs(np.log(first / second)) <= 2e-3)

    def _columns(self) -> dict[int, slice]:
        """Return where each key's variables stand: weights first, then sensors."""
        weights = self.drive.coverage.columns
        first = len(self.drive.coverage.information)
        own = columns_of(tuple(self.drive.view.sensors))
        return weights | {key: slice(first + at.start, first + at.stop) for key, at in own.items()}


def _factors(readings: UncertainReadings, form: FactorForm) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a group of readings."""
    graph = gtsam.NonlinearFactorGraph()
    if form is FactorForm.BLOCK:
        graph.add(uncertain_block_factor(readings))
    else:
        for reading in range(len(readings)):
            graph.add(uncertain_reading_factor(readings, reading))
    return graph
