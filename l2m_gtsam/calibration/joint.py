"""The joint graph over ``T(i)``, ``D(i)`` and ``S(i)``: the finish of the solve, and how sure."""

from dataclasses import dataclass, field, replace
from functools import partial

import gtsam
import numpy as np

from l2m_factors import BatchedReadings
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.cluster_robust import Excess, scatters, unmodelled
from l2m_gtsam.calibration.coverage import Correction
from l2m_gtsam.calibration.determined import determinacies
from l2m_gtsam.calibration.factor_graph import (
    Estimate,
    batch_readings,
    prior_graph,
    reading_graph,
    whitened_jacobian,
)
from l2m_gtsam.calibration.half_difference import HalfDifference
from l2m_gtsam.calibration.joint_information import Rows
from l2m_gtsam.calibration.optimise import (
    NEARLY,
    TOLERANCE,
    Ending,
    JointCovariance,
    covariance_by_qr,
    joint_covariance,
    optimise,
    polish,
)
from l2m_gtsam.calibration.pose_errors import at_likely_poses, error_of_poses
from l2m_gtsam.calibration.priors import Contradiction, contradictions
from l2m_gtsam.calibration.sensor_columns import SENSOR, keys_of
from l2m_gtsam.calibration.stated_sizes import take_all_noise
from l2m_gtsam.calibration.variance_parts import Parts, by_block
from l2m_gtsam.calibration.view import QueryableMap, View
from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import undetermined
from l2m_gtsam.records.calibration import ResidualFigures
from l2m_gtsam.records.error_budget import EXPLAINED, ErrorCause, Unmodelled
from l2m_gtsam.solve.noise import (
    HALF,
    estimate_noise,
    map_covariance,
    reading_covariance,
    residual_figures,
    whitening,
)
from l2m_gtsam.solve.rank import Determinacy

# Of each round whose weights may be the last; two of these at least are made, and each step
# shortens what remains fourfold.
POLISHING_STEPS = 2
H_ROWS = slice(12, 15)  # of H among t, C and H
OWN = np.arange(SENSOR)  # where a sensor that shares no error stands among its variables


@dataclass(frozen=True)
class SensorSolution:
    """What the joint graph says of one sensor.

    Attributes
    ----------
    sensor
        Index of the sensor.
    joint_covariance
        Of (t, C row by row, H, time offset) in m, uT and s; undetermined parameters have infinite
        variance and no correlation, shape (16, 16).
    figures
        Residuals of the readings used.
    determinacy
        What the data determine.
    remaining_sigmas
        Length of the Newton step that remains, in standard deviations.
    contradictions
        What was known of the sensor beforehand and the readings speak against.
    moving
        What recorded numbers add to the readings, beyond what was taken off them; absent where it
        is no variable of the graph.
    shared_root
        This sensor's rows, t, C row by row and H, of a root of the covariance of all sensors,
        shape (15, K): two of them have the covariance ``root_a @ root_b.T`` in common, by errors
        of map and poses. Absent where errors are not shared.
    unmodelled
        How far the covariance exceeds that of the model.
    variances
        What each cause has of the variances of t, C and H, shape (3,); empty where errors are not
        shared.
    halves
        By how much the halves of the drive differ; absent where errors are not shared.
    """

    sensor: int
    joint_covariance: FloatArray
    figures: ResidualFigures
    determinacy: Determinacy
    remaining_sigmas: float
    contradictions: tuple[Contradiction, ...] = ()
    moving: Correction | None = None
    shared_root: FloatArray | None = None
    unmodelled: Unmodelled = EXPLAINED
    variances: Parts = field(default_factory=dict)
    halves: HalfDifference | None = None

    def widened(self, excess: Excess) -> "SensorSolution":
        """Return the same with larger covariances; correlations with other sensors stay."""
        if excess.factors == EXPLAINED:
            return self
        covariance, root = excess.widened(self.joint_covariance), self.shared_root
        known = np.isfinite(np.diag(covariance))
        scale = np.ones(len(covariance))
        scale[known] = np.sqrt(np.diag(covariance)[known] / np.diag(self.joint_covariance)[known])
        return replace(
            self,
            joint_covariance=covariance,
            shared_root=None if root is None else scale[:-1, None] * root,
            unmodelled=excess.factors,
        )

    def with_shared_error(self, cause: ErrorCause, root: FloatArray) -> "SensorSolution":
        """Return the same with an error that is not in the graph and that all sensors share.

        Parameters
        ----------
        cause
            Whose error.
        root
            This sensor's rows, with the time offset, of a root of its covariance, shape (16, m).
        """
        added, known = root @ root.T, np.isfinite(np.diag(self.joint_covariance))
        covariance = self.joint_covariance + np.where(np.outer(known, known), added, 0.0)
        own = [] if self.shared_root is None else [self.shared_root]
        part = self.variances.get(cause, np.zeros(3)) + by_block(np.diag(added))
        variances = {**self.variances, cause: part} if self.variances else {}
        return replace(
            self,
            joint_covariance=covariance,
            shared_root=np.hstack([*own, root[:-1]]) if own else None,
            variances=variances,
        )

    def with_spread_of_H(self, spread: FloatArray) -> "SensorSolution":
        """Return the same where H varies by as much, uT^2, shape (3, 3), on its own."""
        before, covariance = np.diag(self.joint_covariance), self.joint_covariance.copy()
        # What is not determined stays so, without correlation.
        known = np.flatnonzero(np.isfinite(before[H_ROWS]))
        at = H_ROWS.start + known
        covariance[np.ix_(at, at)] += spread[np.ix_(known, known)]
        root = self.shared_root
        if root is not None:  # others' rows have nothing of it: what two have in common stays
            scale = np.ones(len(root))
            scale[at] = np.sqrt(np.diag(covariance)[at] / before[at])
            root = scale[:, None] * root
        wander = self.variances.get(ErrorCause.WANDER, np.zeros(3)).copy()
        wander[2] += np.trace(spread)
        variances = {**self.variances, ErrorCause.WANDER: wander} if self.variances else {}
        return replace(self, joint_covariance=covariance, shared_root=root, variances=variances)

    @property
    def covariance(self) -> FloatArray:
        """Of (t, C row by row, H) alone, shape (15, 15)."""
        return self.joint_covariance[:-1, :-1]

    @property
    def offset_covariance(self) -> FloatArray:
        """Of (t, C row by row, H) with the time offset, shape (15,)."""
        return self.joint_covariance[:-1, -1]

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of the time offset in seconds."""
        return float(np.sqrt(self.joint_covariance[-1, -1]))


@dataclass(frozen=True)
class JointProblem:
    """The joint graph with its weights frozen at one estimate.

    Attributes
    ----------
    view
        The readings used.
    batch
        The same, as the factors evaluate them.
    share
        Covariance that map and poses contribute to each residual in uT^2, shape (N, 3, 3).
    covariance
        Covariance of each residual in uT^2, shape (N, 3, 3).
    determinacies
        Rank test of each sensor.
    graph
        Readings, priors, ridge, and a hold on what these cannot determine.
    """

    view: View
    batch: BatchedReadings
    share: FloatArray
    covariance: FloatArray
    determinacies: dict[int, Determinacy]
    graph: gtsam.NonlinearFactorGraph


@dataclass(frozen=True)
class JointStep:
    """An optimum for frozen weights."""

    estimate: Estimate
    ending: Ending


def joint_problem(
    view: View, field_map: QueryableMap, estimate: Estimate, options: OneKeyOptions
) -> JointProblem:
    """Build the joint graph at an estimate: rank test first, undetermined directions held."""
    sensor, C = view.readings.sensor, estimate.C()[view.readings.sensor]
    share = map_covariance(C, view.readings.R_map_lidar, view.map_variance)
    features = error_of_poses(view.readings, field_map, estimate)
    by_pose = C @ features
    share += by_pose @ by_pose.transpose(0, 2, 1)
    covariance = reading_covariance(view.readings.noise(estimate.noise), share, view.trust)
    values, W, readings = estimate.values(view.sensors), whitening(covariance), view.readings
    noise = estimate.noise[view.sensors]
    if readings.pose_root is not None and not take_all_noise(noise):
        e = np.einsum("nij,nj->ni", C, view.b_lidar) + estimate.distortion[sensor, 9:]
        white = np.einsum("nij,nj->ni", W, e - readings.field)
        errors = -np.einsum("nij,ni->nj", W @ by_pose, white)
        readings = at_likely_poses(readings, readings.pose_root, errors, features, C)
    batch = batch_readings(readings, field_map)
    jacobians = {s: whitened_jacobian(batch, W, values, s) for s in view.sensors}
    tests = determinacies(jacobians, estimate.priors, values, options.rank)
    graph = reading_graph(batch, covariance, options.factors)
    graph.push_back(prior_graph(estimate, tests))
    return JointProblem(view, batch, share, covariance, tests, graph)


def joint_step(
    problem: JointProblem, estimate: Estimate, options: OneKeyOptions, *, exact: bool
) -> JointStep:
    """Optimise T(i), D(i), S(i) of all sensors, then the noise from the residuals that remain.

    With the weights of an intermediate stage a descent that has nearly ended is enough. ``exact``
    goes on from the end of such a descent to where the gradient vanishes; if that way is uphill, it
    descends to the end.
    """
    sensors = problem.view.sensors
    start, steps = estimate.values(sensors), options.joint_iterations
    optimised = polish(problem.graph, start, POLISHING_STEPS) if exact else None
    if optimised is None or optimised.ending is not Ending.TOLERANCE:
        enough = TOLERANCE if exact else NEARLY
        optimised = optimise(problem.graph, start, options.optimizer, steps, tolerance=enough)
    after = estimate.updated(optimised.values, sensors)
    most = options.largest_offset_s
    after = replace(after, offset=np.clip(after.offset, -most, most))
    if options.sensor_noise_ut is None:
        after = replace(after, noise=_noise(problem, after))
    return JointStep(after, optimised.ending)


def _noise(problem: JointProblem, estimate: Estimate) -> FloatArray:
    """Return the most likely noise of each sensor in uT, shape (S,)."""
    noise, values = estimate.noise.copy(), estimate.values(problem.view.sensors)
    ratio = problem.view.readings.noise_ratio
    variance = np.trace(problem.share, axis1=1, axis2=2) / (3 * ratio**2)
    for s in problem.view.sensors:
        rows, taken = problem.batch.rows_of(s), problem.determinacies[s].free
        rows = rows[problem.view.trust[rows] > HALF]
        residual = problem.batch.residuals(values, s).residual[rows] / ratio[rows, None]
        noise[s] = estimate_noise(residual, variance[rows], 1 - taken / residual.size)
    return noise


@dataclass(frozen=True)
class JointOptimum:
    """The joint graph where its own weights have it.

    Attributes
    ----------
    values
        The optimum.
    linear
        The graph linearised there.
    among
        Covariances of all parameters of some sensors.
    whitenings
        Of each residual, shape (N, 3, 3).
    """

    values: gtsam.Values
    linear: gtsam.GaussianFactorGraph
    among: JointCovariance
    whitenings: FloatArray

    @classmethod
    def of(cls, problem: JointProblem, estimate: Estimate) -> "JointOptimum":
        """Linearise the graph at an estimate."""
        values = estimate.values(problem.view.sensors)
        linear = problem.graph.linearize(values)
        among = joint_covariance(linear, values, partial(covariance_by_qr, linear))
        return cls(values, linear, among, whitening(problem.covariance))


def sensor_solutions(problem: JointProblem, estimate: Estimate) -> tuple[SensorSolution, ...]:
    """Return covariance and figures of every sensor at the optimum of its own weights."""
    return _solutions(problem, estimate, JointOptimum.of(problem, estimate))


def robust_solutions(problem: JointProblem, estimate: Estimate) -> tuple[SensorSolution, ...]:
    """Return the same with covariances that hold what the scatter of parts of the drive shows."""
    optimum, widened = JointOptimum.of(problem, estimate), []
    values, W = optimum.values, optimum.whitenings
    for found in _solutions(problem, estimate, optimum):
        s = found.sensor
        rows = problem.batch.rows_of(s)
        residual = problem.batch.residuals(values, s).residual[rows]
        white = (W[rows] @ residual[:, :, None]).ravel()
        own = Rows(s, OWN, whitened_jacobian(problem.batch, W, values, s), white, rows)
        covariance, together = optimum.among((s,)), len(problem.view.sensors)
        parts = scatters(problem.view.readings, [own], OWN, covariance)
        excess = unmodelled(parts, OWN, covariance, together)
        widened.append(found.widened(excess))
    return tuple(widened)


def _solutions(
    problem: JointProblem, estimate: Estimate, optimum: JointOptimum
) -> tuple[SensorSolution, ...]:
    values, among = optimum.values, optimum.among
    missed = contradictions(estimate.priors.among(problem.view.sensors), values, among)
    gradients = optimum.linear.gradientAtZero()
    solutions = []
    for s in problem.view.sensors:
        rows, test = problem.batch.rows_of(s), problem.determinacies[s]
        residual = problem.batch.residuals(values, s).residual[rows]
        white = np.einsum("nij,nj->ni", optimum.whitenings[rows], residual)
        covariance = among((s,))
        gradient = np.concatenate([gradients.at(key) for key in keys_of(s)])
        solutions.append(
            SensorSolution(
                sensor=s,
                joint_covariance=with_infinities(covariance, test),
                figures=residual_figures(residual, white, test.free),
                determinacy=test,
                remaining_sigmas=float(np.sqrt(gradient @ covariance @ gradient)),
                contradictions=tuple(each for each in missed if s in each.sensors),
            )
        )
    return tuple(solutions)


def with_infinities(covariance: FloatArray, test: Determinacy) -> FloatArray:
    """Return a sensor's covariance, (16, 16), infinite instead of what held directions have.

    A parameter that such a direction touches has infinite variance and no correlation.
    """
    return undetermined(covariance, np.append(test.touched, not test.offset))
