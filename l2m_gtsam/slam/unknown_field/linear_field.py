"""A field that is linear in weights of unit prior variance: first weights, effective parameters."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky
from scipy.spatial import cKDTree

from l2m_factors import ComplexityPenalty, TileField
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.solve.robust import SEEDS

AXES = 3
REWEIGHTINGS = 15
SIDE_M = 1e-3  # of a finite difference
SHARE = 0.25  # of the readings of a place, beyond which rejected ones are no spikes
LARGE = 2.0  # length of a whitened residual beyond which a reading is downweighted


@dataclass(frozen=True)
class LinearField(ABC):
    """Features of m weights, in the frame of the key pose that the field is fixed to.

    Attributes
    ----------
    basis
        m basis functions.
    scale
        Prior standard deviation of each one's weight, shape (m,).
    """

    basis: TileField
    scale: FloatArray

    def __len__(self) -> int:
        return len(self.scale)

    def features(self, points: FloatArray, /) -> FloatArray:
        """Return the field of weights of unit prior variance in uT, shape (N, 3, m)."""
        return self.basis.features(points) * self.scale

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray, /
    ) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        return self.basis.field_and_gradient(points, self.scale * weights)

    @abstractmethod
    def unresolved(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis of what the weights do not hold, uT^2, shape (N, 3)."""

    @abstractmethod
    def unresolved_together(self, points: FloatArray) -> FloatArray:
        """Return it times the number of points that have it in common, uT^2, shape (N, 3).

        Near each other it is the same error, of which n readings say no more than one. With n
        times the variance each they say as little, where readings count as independent.
        """

    @property
    @abstractmethod
    def half_wave(self) -> float:
        """Half of the shortest wave that it holds, metres; 0 where the others count as noise."""

    def away_from_steel(self, points: FloatArray, trust: FloatArray) -> FloatArray:
        """Return the weights of readings, 0 where many others have weight 0, shape (N,).

        Steel that is nearer than the waves are short makes a field that they do not hold. On the
        flank of such a place a reading may pass for noise, but all of them pull the poses.

        Parameters
        ----------
        points
            Readings in the anchor's frame in metres, shape (N, 3).
        trust
            Weight of each by itself, shape (N,).
        """
        wrong = points[trust <= REJECTED_WEIGHT]
        if self.half_wave == 0 or len(wrong) < SEEDS:
            return trust
        several, there = (
            cKDTree(each).query_ball_point(wrong, self.half_wave, return_length=True)
            for each in (wrong, points)
        )
        steel = (several >= SEEDS) & (several >= SHARE * there)
        if not steel.any():
            return trust
        away, _ = cKDTree(wrong[steel]).query(points)
        return np.where(away < self.half_wave, 0.0, trust)

    def robust_weights(
        self, points: FloatArray, field: FloatArray, variance: FloatArray
    ) -> FloatArray:
        """Return a robust estimate of the weights from readings with outliers, shape (m,).

        Iteratively reweighted least squares with Huber weights.

        Parameters
        ----------
        points, field
            Readings in the anchor's frame, metres and uT, shapes (N, 3).
        variance
            Of each one's noise per axis in uT^2, shape (N, 3).
        """
        root = 1 / np.sqrt(variance)
        F = (self.features(points) * root[:, :, None]).reshape(-1, len(self))
        y, trust = (field * root).ravel(), np.ones(len(points))
        weights: FloatArray = np.zeros(len(self))
        for _ in range(REWEIGHTINGS):
            by = np.repeat(trust, AXES)
            information = F.T @ (F * by[:, None]) + np.eye(len(self))
            weights = np.asarray(np.linalg.solve(information, F.T @ (by * y)))
            off = np.linalg.norm((F @ weights - y).reshape(-1, AXES), axis=1)
            trust = 1 / np.maximum(off / LARGE, 1.0)
        return weights

    @abstractmethod
    def penalised(self, lower: FloatArray) -> FloatArray:
        """Return the B of the penalty ``sum |F B|^2 / (2 sigma^2)``, shape (m, m).

        ``lower`` is the Cholesky factor of the weights' information after all readings, shape
        (m, m); see :class:`l2m_factors.ComplexityPenalty`.
        """

    def information(self, points: FloatArray, variance: FloatArray) -> FloatArray:
        """Return the readings' information about the weights, (m, m); see ``penalty``."""
        F = (self.features(points) / np.sqrt(variance)[:, :, None]).reshape(-1, len(self))
        return np.asarray(F.T @ F)

    def penalty(
        self, points: FloatArray, variance: FloatArray, past_information: FloatArray | None = None
    ) -> ComplexityPenalty:
        """Return each reading's share of the penalty of complexity.

        Parameters
        ----------
        points
            In the anchor's frame in metres, shape (N, 3).
        variance
            Of each reading's noise per axis in uT^2, shape (N, 3).
        past_information
            Information of other readings about the weights, shape (m, m).
        """
        known = np.eye(len(self)) + self.information(points, variance)
        lower = cholesky(
            known if past_information is None else known + past_information, lower=True
        )
        B = self.penalised(lower)
        root = 1 / np.sqrt(variance)[:, :, None]
        share = root * (self.features(points) @ B)
        value = np.sqrt(np.einsum("nam,nam->n", share, share))
        by_features = root * (share @ B.T) / value[:, None, None]
        steps = SIDE_M * np.eye(AXES)
        slopes = [
            np.einsum("nam,nam->n", by_features, self.features(points + step))
            for step in (*steps, *-steps)
        ]
        slope = (np.stack(slopes[:AXES], axis=1) - np.stack(slopes[AXES:], axis=1)) / (2 * SIDE_M)
        return ComplexityPenalty(points, value, slope)
