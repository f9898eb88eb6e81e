"""The slow reference: one Gaussian process over all readings, written straight from the book.

Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, algorithm 2.1. It shares
nothing with the sliding process but its training rows, so that each tests the other.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.spatial.distance import cdist

from l2m_gtsam.data import FieldAndGradient, FieldSample, FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import masked
from l2m_gtsam.maps.hyperparameters import not_definite
from l2m_gtsam.maps.trained import GPMap, GPOptions, Trained
from l2m_gtsam.maps.training import checked_points

MOST_ROWS = 6000  # the factor of as many takes 290 MB
BATCH = 64  # points whose differences to all readings are in memory at once


class DenseGPOptions(GPOptions):
    """Options of the dense Gaussian process; lengths are in length scales."""


@dataclass(frozen=True)
class DenseGP(GPMap[DenseGPOptions]):
    """A field map of one Gaussian process.

    Attributes
    ----------
    factor
        Lower Cholesky factor of the readings' covariance in microtesla, shape (M, M).
    alpha
        Weights of the readings in 1/microtesla, shape (M, 3).
    """

    kind = "dense_gp"
    model = DenseGPOptions
    factor: FloatArray
    alpha: FloatArray

    @classmethod
    def condition(cls, trained: Trained, options: DenseGPOptions) -> "DenseGP":
        """Return the map of readings whose hyperparameters are known.

        Raises
        ------
        MapError
            If there are too many readings or their covariance cannot be factorised.
        """
        readings = trained.readings
        if len(readings) > MOST_ROWS:
            raise MapError(
                f"a map of kind {cls.kind} holds at most {MOST_ROWS} training readings after "
                f"thinning, got {len(readings)}; kind sliding_gp has no such limit"
            )
        K = covariance(trained, readings.points) + np.diag(trained.noise_variance)
        try:
            factor = cholesky(K, lower=True)
        except LinAlgError:
            raise MapError(not_definite(trained.hyperparameters)) from None
        # The mean is k^T alpha with alpha = (K + noise)^-1 (y - mean) (Rasmussen and Williams 2006,
        # 2.25).
        alpha = cho_solve((factor, True), readings.field - readings.mean)
        return cls(trained, options, readings.mean, factor, alpha)

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance; see ``FieldMap``."""
        points = checked_points(points)
        field, gradient = self.field_and_gradient(points)
        reach = self.options.reach * self.trained.hyperparameters.length_scale
        nearest = [
            cdist(batch, self.trained.readings.points).min(axis=1) for batch in batches(points)
        ]
        inside = np.concatenate([np.empty(0), *nearest]) <= reach
        return masked(FieldSample(field, gradient, self.variance(points), inside))

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient, also outside; see ``FieldMap``."""
        points = checked_points(points)
        y = self.trained.readings.points
        squared_scale = self.trained.hyperparameters.length_scale**2
        fields, gradients = [np.empty((0, 3))], [np.empty((0, 3, 3))]
        for batch in batches(points):
            k = covariance(self.trained, batch)
            slope = -(batch[:, None, :] - y) / squared_scale * k[:, :, None]
            fields.append(self.mean + k @ self.alpha)
            gradients.append(np.einsum("nmj,mi->nij", slope, self.alpha))
        return np.concatenate(fields), np.concatenate(gradients)

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis, also outside; see ``FieldMap``."""
        prior = self.trained.hyperparameters.signal**2
        variances = [np.empty(0)]
        for batch in batches(checked_points(points)):
            # As L^-1 k: the explained variance is a sum of squares, and no inverse is formed.
            V = solve_triangular(self.factor, covariance(self.trained, batch).T, lower=True)
            variances.append(np.maximum(prior - np.sum(V**2, axis=0), 0.0))
        return np.repeat(np.concatenate(variances)[:, None], 3, axis=1)


def covariance(trained: Trained, points: FloatArray) -> FloatArray:
    """Return the prior covariance of points with the training rows in uT^2, shape (N, M)."""
    hyperparameters = trained.hyperparameters
    squared = cdist(points, trained.readings.points, "sqeuclidean")
    return hyperparameters.signal**2 * np.exp(-0.5 * squared / hyperparameters.length_scale**2)


def batches(points: FloatArray) -> Iterator[FloatArray]:
    """Yield the points a few at a time."""
    for start in range(0, len(points), BATCH):
        yield points[start : start + BATCH]
