"""Covariances of what the graphs of SLAM determine."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

import gtsam
import numpy as np

from l2m_factors import D, G, T, V, X
from l2m_gtsam.calibration.joint_information import columns_at, slices_of
from l2m_gtsam.calibration.optimise import Ending, refused
from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.localisation import OdometryScale, OdometryTurn
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.pose_graph import link_squared, odometry_graph, steady_drift
from l2m_gtsam.slam.relative_motion import DrivePrediction
from l2m_gtsam.slam.selected_inverse import inverse_of, shared_covariances
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.solve.linear_algebra import triangular_information_root

Result = TypeVar("Result")


@contextmanager
def reported_ill_conditioning() -> Iterator[None]:
    """Raise a CalibrationError in one line where GTSAM cannot factor what is done inside.

    Raises
    ------
    CalibrationError
        A system is indeterminate. A prior determines every variable at least indirectly, so that
        the cause is bad scaling.
    """
    try:
        yield
    except (RuntimeError, np.linalg.LinAlgError) as error:
        if isinstance(error, RuntimeError) and not refused(error):
            raise
        raise CalibrationError(
            "the covariances of the poses cannot be computed: those of odometry, start and "
            "calibration are too many orders of magnitude apart"
        ) from error


class PoseCovariance(Protocol):
    """The joint covariance of a drive's poses."""

    def variance_along(self, directions: Mapping[int, FloatArray], /) -> float:
        """Return ``d^T P d`` for a direction d in which poses move together."""


class Marginals:
    """Covariances of a linear graph's variables, by Cholesky, or by QR where that fails.

    GTSAM's Cholesky fails on directions 4,000 times weaker than others; QR does not.

    Parameters
    ----------
    linear
        The graph, linearised at its solution.
    ordering
        Elimination order of its variables.
    """

    def __init__(self, linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> None:
        self._linear, self._ordering = linear, ordering

    def of(self, key: int) -> FloatArray:
        """Return the covariance of one variable."""
        return self.joint([key])

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Return the joint covariance of some variables, in this order."""
        tree, own = self._cholesky, list(keys)
        if tree is not None:
            covariance = unless_indeterminate(
                lambda: tree.jointMarginalCovariance(own).fullMatrix()
            )
            if covariance is not None:
                return np.asarray(covariance)
        left = self._qr.joint(own, gtsam.EliminateQR)
        net = left.eliminateSequential(gtsam.Ordering(own), gtsam.EliminateQR)
        return net_covariance(net, keys)

    def sharing(self, groups: Sequence[Sequence[int]]) -> list[FloatArray]:
        """Return joint covariances of many groups of variables, each of which shares a factor.

        At the cost of another elimination, however many there are.
        """
        return shared_covariances(self._net, groups)

    def variance_along(self, directions: Mapping[int, FloatArray]) -> float:
        """Return ``d^T P d`` for a direction d in which variables move together.

        Parameters
        ----------
        directions
            Its part of each variable, shapes (6,) for poses.
        """
        # P d is where the minimum goes if the cost is less by d times the variables.
        pulled = gtsam.GaussianFactorGraph()
        pulled.push_back(self._linear)
        for key, own in directions.items():
            pulled.add(gtsam.HessianFactor(key, np.zeros((len(own), len(own))), own, 0.0))
        tree = self._cholesky
        after = unless_indeterminate(lambda: pulled.optimize(self._ordering))
        if tree is None or after is None:  # errors that go together are the largest
            sigma = (np.sqrt(own @ self.of(key) @ own) for key, own in directions.items())
            return float(sum(sigma)) ** 2
        before = tree.optimize()
        return float(sum(own @ (after.at(key) - before.at(key)) for key, own in directions.items()))

    def log_determinant(self, without: Sequence[int] = ()) -> float:
        """Return half of the logarithm of the determinant of the information.

        Parameters
        ----------
        without
            Variables that are integrated out; each has a prior.
        """
        tree = self._qr if self._cholesky is None else self._cholesky
        whole = float(tree.logDeterminant())
        if not without:
            return whole
        # The conditionals of what is eliminated first are its information where the rest is known.
        first, _ = self._linear.eliminatePartialMultifrontal(gtsam.Ordering(list(without)))
        return whole - float(first.logDeterminant())

    @cached_property
    def _cholesky(self) -> gtsam.GaussianBayesTree | None:
        return unless_indeterminate(lambda: self._linear.eliminateMultifrontal(self._ordering))

    @cached_property
    def _net(self) -> gtsam.GaussianBayesNet:
        net = unless_indeterminate(lambda: self._linear.eliminateSequential(self._ordering))
        if net is None:
            net = self._linear.eliminateSequential(self._ordering, gtsam.EliminateQR)
        return net

    @cached_property
    def _qr(self) -> gtsam.GaussianBayesTree:
        return self._linear.eliminateMultifrontal(self._ordering, gtsam.EliminateQR)


@dataclass(frozen=True)
class JointPosterior:
    """What a linear graph says of some of its variables.

    Attributes
    ----------
    covariance
        Joint, shape (n, n).
    mean
        From where the graph was linearised, shape (n,).
    decrease
        Of the error from zero to the solution: what a step of Gauss and Newton promises.
    """

    covariance: FloatArray
    mean: FloatArray
    decrease: float


def joint_posterior(linear: gtsam.GaussianFactorGraph, keys: Sequence[int]) -> JointPosterior:
    """Return the joint posterior of some variables, in this order, by eliminating the others.

    For a single query: 0.03 s for one pose of a section, where a tree of all takes 0.11 s. What is
    left is dense. GTSAM decides whether Cholesky solves it, and LAPACK inverts it: 55 ms in all for
    270 components, where GTSAM's covariance of its tree takes 77.
    """
    last = gtsam.Ordering(list(keys))

    def by_cholesky() -> tuple[FloatArray, FloatArray, float]:
        left = linear.marginal(list(keys))
        left.eliminateMultifrontal(last)
        augmented = left.augmentedHessian(last)
        W = triangular_information_root(augmented[:-1, :-1], 0.0)
        # Its constant is twice the error at the solution for the others, and these at zero.
        white = W @ augmented[:-1, -1]
        least = float(0.5 * (augmented[-1, -1] - white @ white))
        return np.asarray(W.T @ W), np.asarray(W.T @ white), least

    def by_qr() -> tuple[FloatArray, FloatArray, float]:
        net = linear.marginalMultifrontalBayesNet(last, gtsam.EliminateQR)
        best = linear.optimize(gtsam.EliminateQR)
        mean = np.concatenate([best.at(key) for key in keys])
        return net_covariance(net, keys), mean, linear.error(best)

    covariance, mean, least = unless_indeterminate(by_cholesky) or by_qr()
    here = linear.error(gtsam.VectorValues.Zero(linear.gradientAtZero()))
    return JointPosterior(covariance, mean, here - least)


def unless_indeterminate(work: Callable[[], Result]) -> Result | None:
    """Return what GTSAM computes; None where a linear system is indeterminate to it."""
    try:
        return work()
    except (RuntimeError, ValueError) as error:
        if not refused(error):
            raise
        return None


def net_covariance(net: gtsam.GaussianBayesNet, keys: Sequence[int]) -> FloatArray:
    """Return the joint covariance of a net's variables, each eliminated by itself, in this order.

    GTSAM eliminates along a tree: the variables of another branch may come first, whatever the
    ordering says.
    """
    parts = [net.at(row) for row in range(net.size())]
    slices = slices_of({each.firstFrontalKey(): len(each.R()) for each in parts})
    at = columns_at(slices, keys)
    return covariance_of(net.matrix()[0])[np.ix_(at, at)]


def covariance_of(root: FloatArray) -> FloatArray:
    """Return ``(R^T R)^-1`` of an upper triangle R.

    GTSAM would invert ``R^T R`` by Cholesky, which squares the condition number again.
    """
    half = inverse_of(root)
    return np.asarray(half @ half.T)


@dataclass(frozen=True)
class DriveCovariances:
    """Covariances of a drive's variables.

    Attributes
    ----------
    poses
        Of right perturbations of the K key poses, rotation (rad) before translation (m), shape
        (K, 6, 6).
    steps
        Joint ones of the poses before and after odometry's J jumps, shape (J, 12, 12).
    sensors
        Of (t, C row by row, H) of the S sensors in m and uT, shape (S, 15, 15); the known ones
        where calibrations are no variables.
    """

    poses: FloatArray
    steps: FloatArray
    sensors: FloatArray


def drive_covariances(
    marginals: Marginals, drive: Drive, sensors: KnownSensors, values: gtsam.Values
) -> DriveCovariances:
    """Return what a drive's graph determines, all at the cost of one elimination.

    Parameters
    ----------
    marginals
        Of the graph.
    drive
        K key poses.
    sensors
        Its sensors as they were known.
    values
        Of the graph's variables.
    """
    poses = [[X(k)] for k in range(len(drive))]
    steps = [[X(each.step), X(each.step + 1)] for each in drive.jumps]
    free = values.exists(T(0))
    calibrations = [[T(i), D(i)] for i in range(len(sensors.names))] if free else []
    with reported_ill_conditioning():
        found = marginals.sharing([*poses, *steps, *calibrations])
    K, J = len(poses), len(steps)
    return DriveCovariances(
        np.stack(found[:K]),
        np.reshape(found[K : K + J], (-1, 2 * POSE, 2 * POSE)),
        np.stack(found[K + J :]) if free else sensors.covariance,
    )


def solved_drive(
    drive: Drive,
    values: gtsam.Values,
    marginals: Marginals,
    predicted: DrivePrediction,
    weights: FloatArray,
    ending: Ending,
) -> DriveSolution:
    """Return a drive as its graph solves it, without changes of the map.

    Parameters
    ----------
    drive
        K key poses with N readings, of sensors as they are estimated.
    values, marginals
        Of the graph's variables.
    predicted
        Its readings at these.
    weights
        Their robust weights, shape (N,).
    ending
        Why the optimisation stopped.
    """
    covariances = drive_covariances(marginals, drive, drive.sensors, values)
    return DriveSolution(
        drive=drive,
        poses=poses_in(values, len(drive)),
        pose_covariance=covariances.poses,
        calibration_covariance=covariances.sensors,
        prediction=predicted.prediction,
        interpolation_covariance=predicted.interpolation_covariance,
        squared=predicted.squared(drive.sensors.noise),
        weights=weights,
        near_changes=np.zeros(len(weights), dtype=np.bool_),
        odometry_chi2=2 * odometry_graph(drive).error(values) / (POSE * len(drive)),
        link_squared=link_squared(drive.links, values),
        ending=ending,
        step_covariance=covariances.steps,
        scale=odometry_scale(marginals, values),
        turn=odometry_turn(marginals, values, drive),
        steady=steady_drift(values),
    )


def pose_covariances(marginals: Marginals, count: int) -> FloatArray:
    """Return covariances of the first ``count`` key poses; see ``DriveCovariances``."""
    with reported_ill_conditioning():
        return np.stack(marginals.sharing([[X(k)] for k in range(count)]))


def odometry_scale(marginals: Marginals, values: gtsam.Values) -> OdometryScale | None:
    """Return the estimate of odometry's scale; None where it is no variable."""
    if not values.exists(G()):
        return None
    with reported_ill_conditioning():
        variance = float(marginals.of(G())[0, 0])
    return OdometryScale(values.atDouble(G()), float(np.sqrt(variance)))


def odometry_turn(marginals: Marginals, values: gtsam.Values, drive: Drive) -> OdometryTurn | None:
    """Return the estimate of odometry's steady turning; None where it is no variable."""
    turning = drive.steps.turning
    if turning is None:
        return None
    with reported_ill_conditioning():
        covariance = marginals.of(V())[-2:, -2:]
    per_m = np.rad2deg(turning.sum(axis=0)) / drive.steps.path[-1]
    sigma = np.sqrt(per_m @ covariance @ per_m)
    return OdometryTurn(float(per_m @ values.atVector(V())[-2:]), float(sigma))
