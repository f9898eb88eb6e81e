"""What is known of the motion of a tile's visit without its readings: by odometry, other tiles.

Visits are the nodes of a small pose graph. Odometry, with a drift that all steps share, connects
them in the order of time; the readings of a visit connect it to the first visit of its tile.
Linear in right perturbations of the nodes at their current poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from l2m_factors import drift_weights
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.odometry import OdometrySteps
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.options import DriftOptions
from l2m_gtsam.slam.unknown_field.changed_visits import MOTION, Motion


@dataclass(frozen=True)
class Way:
    """Odometry from one visit to the next.

    Attributes
    ----------
    T
        The later in the frame of the earlier.
    covariance
        Of a right perturbation of it, shape (6, 6).
    steady
        Metres that one unit of the drifts with time and with distance adds along each axis of the
        frame of the poses, shape (2, 3).
    turning
        Right perturbation of it by one unit of a turning with time and with distance, shape (6, 2).
    """

    T: gtsam.Pose3
    covariance: FloatArray
    steady: FloatArray
    turning: FloatArray

    @classmethod
    def over(cls, steps: OdometrySteps, first: int, last: int) -> "Way":
        """Return the way between two key poses."""
        T, covariance, turning = gtsam.Pose3(), np.zeros((POSE, POSE)), np.zeros((POSE, 2))
        turns = np.zeros((len(steps), 3, 2))
        if steps.turning is not None:
            turns = steps.up[:, :, None] * steps.turning[:, None]
        for k in range(first, last):
            step = gtsam.Pose3(gtsam.Rot3(steps.R[k]), steps.p[k])
            carried = step.inverse().AdjointMap()
            covariance = carried @ covariance @ carried.T + steps.covariance[k]
            turning = carried @ turning
            turning[:3] += turns[k]
            T = T.compose(step)
        steady = np.zeros((2, 3)) if steps.steady is None else steps.steady[first:last].sum(axis=0)
        return cls(T, covariance, steady, turning)


def ways_between(steps: OdometrySteps, key_poses: Sequence[int]) -> tuple[Way, ...]:
    """Return odometry from each of some key poses to the next, ascending."""
    if steps.scale:
        steps = steps.with_scale_as_drift(DriftOptions().over_m)
    return tuple(Way.over(steps, *each) for each in pairwise(key_poses))


@dataclass(frozen=True)
class VisitGraph:
    """Visits at their current poses.

    Attributes
    ----------
    nodes
        V poses.
    ways
        Odometry between them, V - 1.
    """

    nodes: tuple[gtsam.Pose3, ...]
    ways: tuple[Way, ...]

    def between(self, first: int, number: int) -> gtsam.Pose3:
        """Return a visit's pose in the frame of another."""
        return self.nodes[first].between(self.nodes[number])

    def solved(self, links: Mapping[int, tuple[int, Motion]]) -> "SolvedVisits":
        """Return what is known of all visits.

        Parameters
        ----------
        links
            By the number of a visit: that of the first of its tile, and what its readings say of
            its motion relative to that.
        """
        size = POSE * len(self.nodes) + DRIFT
        information, pulled = np.zeros((size, size)), np.zeros(size)
        own = slice(0, POSE)
        # The first visit is where it is, and the drift as large as its unit says.
        information[own, own] = np.diag(1e12 * np.ones(POSE))
        information[-DRIFT:, -DRIFT:] = np.eye(DRIFT)
        for number, way in enumerate(self.ways):
            rows, by = self._way(number, way)
            weight = np.linalg.inv(way.covariance)
            information[np.ix_(rows, rows)] += by.T @ weight @ by
            e = gtsam.Pose3.Logmap(way.T.between(self.between(number, number + 1)))
            pulled[rows] -= by.T @ weight @ e
        for number, (first, motion) in links.items():
            rows, by = self.relative(first, number)
            information[np.ix_(rows, rows)] += by.T @ motion.information @ by
            pulled[rows] += by.T @ motion.pulled
        factor = cho_factor(information)
        return SolvedVisits(self, cho_solve(factor, pulled), cho_solve(factor, np.eye(size)))

    def _way(self, number: int, way: Way) -> tuple[IntArray, FloatArray]:
        """Return variables of odometry's way from a visit, and the derivatives by them."""
        rows, by = self.relative(number, number + 1)
        drift = np.zeros((POSE, DRIFT))
        R = self.nodes[number + 1].rotation().matrix()
        drift[3:, :POSE] = R.T @ drift_weights(way.steady)[3:]
        drift[:, POSE:] = way.turning
        size = POSE * len(self.nodes)
        return np.append(rows, size + np.arange(DRIFT)), np.hstack([by, drift])

    def relative(self, first: int, number: int) -> tuple[IntArray, FloatArray]:
        """Return variables of the motion of a visit relative to another, and derivatives."""
        back = -self.between(first, number).inverse().AdjointMap()
        columns = np.arange(POSE)
        rows = np.concatenate([POSE * first + columns, POSE * number + columns])
        return rows, np.hstack([back, np.eye(POSE)])


@dataclass(frozen=True)
class SolvedVisits:
    """Visits with what is known of them.

    Attributes
    ----------
    graph
        Visits where they were.
    mean, covariance
        Of their right perturbations, and of the drift, shapes (6 V + 8,) and both ways.
    """

    graph: VisitGraph
    mean: FloatArray
    covariance: FloatArray

    def moved(self) -> VisitGraph:
        """Return the visits where they are now known to be."""
        steps = self.mean[:-DRIFT].reshape(-1, POSE)
        pairs = zip(self.graph.nodes, steps, strict=True)
        return replace(self.graph, nodes=tuple(a.retract(step) for a, step in pairs))

    def motions(self, links: Mapping[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the motions of L visits relative to others, (6 L,)."""
        by = np.zeros((POSE * len(links), len(self.mean)))
        for k, (number, first) in enumerate(links.items()):
            columns, slope = self.graph.relative(first, number)
            by[POSE * k : POSE * (k + 1), columns] = slope
        return by @ self.mean, by @ self.covariance @ by.T

    def without(self, first: int, number: int, own: Motion) -> Motion:
        """Return what is known of a visit relative to another without what it says itself."""
        rows, by = self.graph.relative(first, number)
        P = by @ self.covariance[np.ix_(rows, rows)] @ by.T
        factor = cho_factor(0.5 * (P + P.T))
        information = cho_solve(factor, np.eye(POSE)) - own.information
        pulled = cho_solve(factor, by @ self.mean[rows]) - own.pulled
        # At least what is known of any motion; rounding may leave less.
        values, vectors = np.linalg.eigh(MOTION[:, None] * information * MOTION)
        scaled = vectors / MOTION[:, None]
        return Motion((scaled * np.maximum(values, 1.0)) @ scaled.T, pulled)
