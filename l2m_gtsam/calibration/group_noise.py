"""Shared errors and noise of each group of readings, at an estimate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l2m_factors import M, P, SharedError, U
from l2m_gtsam.calibration.coverage import Coverage, Group
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.pose_errors import PoseKnots, error_of_poses
from l2m_gtsam.calibration.view import QueryableMap, View, places_of
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.linear_algebra import lower_information_root
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening


@dataclass(frozen=True)
class GroupNoise:
    """What the groups of a coverage share and what stays noise.

    Attributes
    ----------
    errors
        Of each group, what its readings share.
    whitenings
        Of each group the matrix or matrices that make the rest white in 1/uT, (n, 3, 3) or
        (3 n, 3 n).
    alone
        The same for each reading by itself, shape (N, 3, 3).
    sensor, of_map, of_poses
        Mean variance of each reading by its sensor alone, and what map and poses leave beside the
        shared errors, uT^2, shapes (N,).
    pose
        What errors of the poses do; absent where poses are exact.
    """

    errors: tuple[tuple[SharedError, ...], ...]
    whitenings: tuple[FloatArray, ...]
    alone: FloatArray
    sensor: FloatArray
    of_map: FloatArray
    of_poses: FloatArray
    pose: "PoseShare | None"

    @property
    def rest(self) -> FloatArray:
        """What map and poses leave together, uT^2, shape (N,)."""
        return self.of_map + self.of_poses

    @property
    def shares(self) -> tuple[FloatArray, FloatArray]:
        """Shares of map and of poses in the variance of each reading, shapes (N,)."""
        whole = self.sensor + self.rest
        return self.of_map / whole, self.of_poses / whole


@dataclass(frozen=True)
class PoseShare:
    """What errors of the poses do to N readings.

    Attributes
    ----------
    knots
        Where they are variables.
    root
        L in rad and m, shape (N, 6, 6).
    seconds
        When poses were taken, shape (N,).
    features
        F in the lidar frame in uT, shape (N, 3, 6).
    in_sensor
        C F, shape (N, 3, 6).
    weights, at_knots
        What the knots say of each time, and are correlated with it, shapes (N, 2).
    """

    knots: PoseKnots
    root: FloatArray
    seconds: FloatArray
    features: FloatArray
    in_sensor: FloatArray
    weights: FloatArray
    at_knots: FloatArray

    def errors(self, group: Group) -> tuple[SharedError, ...]:
        """Return what the readings of a group share: knots before and after, if these matter."""
        weights = self.weights[group.rows]
        F, segment = self.features[group.rows], group.segment
        return tuple(
            SharedError(P(segment + each), weights[:, each, None, None] * F)
            for each in range(weights.shape[1])
            if weights[:, each].any()
        )

    def bridge(self, group: Group) -> FloatArray:
        """Return the covariance of a group's readings that knots leave in uT^2, (3 n, 3 n)."""
        rows, n = group.rows, len(group.rows)
        CF = self.in_sensor[rows].reshape(3 * n, -1)
        left = self._left(group)[:, None, :, None]
        return np.asarray(((CF @ CF.T).reshape(n, 3, n, 3) * left).reshape(3 * n, 3 * n))

    def likely(self, group: Group, weighted: FloatArray) -> FloatArray:
        """Return the most likely errors of a group's poses beside those of the knots, (n, 6).

        ``weighted`` are residuals times the inverse of their covariance, 1/uT, shape (n, 3).
        """
        score = np.einsum("nji,nj->ni", self.in_sensor[group.rows], weighted)
        return np.asarray(-self._left(group) @ score)

    def _left(self, group: Group) -> FloatArray:
        """Return the covariance of a group's errors that knots leave, shape (n, n)."""
        rows = group.rows
        return self.knots.left(self.seconds[rows], self.weights[rows], self.at_knots[rows])


def group_noise(
    view: View, field_map: QueryableMap, coverage: Coverage, estimate: Estimate
) -> GroupNoise:
    """Return errors and noise of all groups.

    Parameters
    ----------
    view, coverage
        Readings, and the errors that they share.
    field_map
        The map.
    estimate
        Whose distortions and places count.
    """
    readings, C = view.readings, estimate.C()[view.readings.sensor]
    share = map_covariance(C, readings.R_map_lidar, coverage.rest)
    noise = readings.noise(estimate.noise)
    own, sensor = reading_covariance(noise, share, view.trust), np.square(noise)
    R_lidar_map = readings.R_map_lidar.transpose(0, 2, 1)
    q = readings.regressors
    of_suite = suite_share(readings, field_map, coverage, estimate)
    shared = [
        (
            SharedError(M(group.tile), R_lidar_map[group.rows] @ group.features),
            *of_suite(group),
            *coverage.moving.errors(group.sensor, None if q is None else q[group.rows]),
            *coverage.budget.errors(group.sensor, group.rows),
        )
        for group in coverage.groups
    ]
    pose = pose_share(readings, field_map, coverage, estimate)
    left, whitenings = np.zeros_like(share), []
    if pose is None:
        alone = whitening(own)
        whitenings = [alone[group.rows] for group in coverage.groups]
    else:
        for number, group in enumerate(coverage.groups):
            each, covariance = np.arange(len(group.rows)), pose.bridge(group)
            blocks = covariance.reshape(len(each), 3, len(each), 3)  # a view
            left[group.rows] = blocks[each, :, each]
            blocks[each, :, each] += own[group.rows]
            whitenings.append(lower_information_root(covariance))
            shared[number] = (*shared[number], *pose.errors(group))
        alone = whitening(own + left)
    return GroupNoise(
        errors=tuple(shared),
        whitenings=tuple(whitenings),
        alone=alone,
        sensor=sensor,
        of_map=_mean_variance(share),
        of_poses=_mean_variance(left),
        pose=pose,
    )


def suite_share(
    readings: Readings, field_map: QueryableMap, coverage: Coverage, estimate: Estimate
) -> Callable[[Group], tuple[SharedError, ...]]:
    """Return what tells how the survey's sensors go into a group's readings; not at all if exact.

    A shift of the map counts with the slope that the sensors' places see: a shift of all of them is
    the same, and nothing in the readings must tell one from the other.
    """
    if not len(coverage.spread):
        return lambda _: ()
    R_lidar_map = readings.R_map_lidar.transpose(0, 2, 1)
    _, gradient = field_map.field_and_gradient(places_of(readings, estimate.t))

    def share(group: Group) -> tuple[SharedError, ...]:
        moved = group.common - gradient[group.rows] @ coverage.shift
        return (SharedError(U(), R_lidar_map[group.rows] @ moved),)

    return share


def pose_share(
    readings: Readings, field_map: QueryableMap, coverage: Coverage, estimate: Estimate
) -> PoseShare | None:
    """Return what errors of the poses do to readings; nothing where poses are exact."""
    if coverage.knots is None or readings.pose_root is None:
        return None
    F = error_of_poses(readings, field_map, estimate)
    C = estimate.C()[readings.sensor]
    knots, seconds = coverage.knots, coverage.seconds
    weights, at_knots = knots.weights(seconds), knots.at_knots(seconds)
    return PoseShare(knots, readings.pose_root, seconds, F, C @ F, weights, at_knots)


def _mean_variance(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariance, axis1=1, axis2=2) / 3)
