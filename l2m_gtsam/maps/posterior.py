"""A Gaussian process: its kernel, and what it predicts near one block for batches of points."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dtrtri

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters, not_definite
from l2m_gtsam.maps.training import TrainingSet

FURTHEST = 1e6
"""Points are pulled to this distance, in length scales, where every kernel is zero anyway."""


def scaled(points: FloatArray, centre: FloatArray, length_scale: float) -> FloatArray:
    """Return points relative to a centre in units of the length scale.

    Parameters
    ----------
    points
        Positions in metres, shape (N, 3).
    centre
        Position in metres, shape (3,), close to the data: the exponent loses digits with the
        square of the distance to it.
    length_scale
        Length scale of the kernel in metres.
    """
    # Points at infinity would give inf - inf in the exponent.
    furthest = FURTHEST * length_scale
    return np.clip(points - centre, -furthest, furthest) / length_scale


def kernel_matrix(x: FloatArray, y: FloatArray, signal: float) -> FloatArray:
    """Return the kernel between scaled points, shape (N, M), in the unit of ``signal`` squared.

    Parameters
    ----------
    x, y
        Scaled points, shapes (N, 3) and (M, 3).
    signal
        Prior standard deviation s in uT.
    """
    return kernel_to(x, training_columns(y, signal))


def training_columns(y: FloatArray, signal: float) -> FloatArray:
    """Return the features of training points in the exponent, shape (5, M); see ``kernel_matrix``.

    They stay the same for all points that are evaluated.
    """
    # s^2 as a summand of the exponent saves one pass over the matrix.
    offset = 2 * np.log(signal) - 0.5 * np.einsum("mi,mi->m", y, y)
    return np.ascontiguousarray(np.column_stack([y, np.ones(len(y)), offset]).T)


def kernel_to(x: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the kernel between scaled points, shape (N, 3), and training points, shape (N, M).

    Parameters
    ----------
    x
        Scaled points, shape (N, 3).
    columns
        From ``training_columns``, shape (5, M).
    """
    rows = np.empty((len(x), 5))
    rows[:, :3], rows[:, 3], rows[:, 4] = x, -0.5 * np.einsum("ni,ni->n", x, x), 1.0
    K = rows @ columns
    np.exp(K, out=K)
    return np.asarray(K)


@dataclass(frozen=True)
class Posterior:
    """What a block needs to answer.

    Attributes
    ----------
    hyperparameters
        Length scale in metres, signal and noise in uT.
    centre
        Origin of the scaled points in metres, shape (3,).
    y
        Scaled training points, shape (M, 3).
    alpha
        Weights of the training readings per axis in 1/uT, shape (M, 3).
    noise_variance
        Of each reading in square microtesla, shape (M,).
    whitener
        Inverse of the lower Cholesky factor of the readings' covariance in 1/uT, shape (M, M), or
        None where memory is short: then it is computed again for each batch that asks for
        variances. A product with it takes a third of the time of a solve with the factor.
    """

    hyperparameters: KernelHyperparameters
    centre: FloatArray
    y: FloatArray
    alpha: FloatArray
    noise_variance: FloatArray
    whitener: FloatArray | None

    @cached_property
    def columns(self) -> FloatArray:
        """Of ``training_columns``, shape (5, M)."""
        return training_columns(self.y, self.hyperparameters.signal)

    def rows(self, points: FloatArray) -> FloatArray:
        """Return the kernel between points in metres, (N, 3), and readings in uT^2, (N, M)."""
        return kernel_to(
            scaled(points, self.centre, self.hyperparameters.length_scale), self.columns
        )

    def variance(self, K: FloatArray) -> FloatArray:
        """Return the posterior variance of each axis in square microtesla, from rows, (N,)."""
        whitener = self.whitener
        if whitener is None:
            whitener = inverted(factorise(self.y, self.noise_variance, self.hyperparameters))
        # k(x, x) - k^T K^-1 k (Rasmussen and Williams 2006, equation 2.26) as a sum of squares.
        V = dtrmm(1.0, whitener, K.T, lower=1)
        explained = np.einsum("mn,mn->n", V, V)
        return np.asarray(np.maximum(self.hyperparameters.signal**2 - explained, 0.0))

    def within(self, K: FloatArray, reach: float) -> BoolArray:
        """Return whether the nearest reading lies within ``reach`` length scales, shape (N,)."""
        # The kernel falls with distance: its largest value belongs to the nearest reading.
        least = self.hyperparameters.signal**2 * np.exp(-0.5 * reach**2)
        return np.asarray(K.max(axis=1) >= least)

    def without_whitener(self) -> "Posterior":
        """Return the same posterior in less memory."""
        return replace(self, whitener=None)


def condition(
    readings: TrainingSet, mean: FloatArray, hyperparameters: KernelHyperparameters
) -> Posterior:
    """Return the process conditioned on readings, by one Cholesky factorisation.

    Parameters
    ----------
    readings
        Of the block and its margin.
    mean
        Prior mean per axis in microtesla, shape (3,).
    hyperparameters
        Length scale in metres, signal and noise in uT.

    Raises
    ------
    MapError
        If the covariance of the readings is not positive definite.
    """
    lower, upper = readings.points.min(axis=0), readings.points.max(axis=0)
    # The exponent loses digits with the square of the distance from the centre.
    centre = 0.5 * (lower + upper)
    y = scaled(readings.points, centre, hyperparameters.length_scale)
    noise_variance = hyperparameters.noise**2 / readings.weight
    factor = factorise(y, noise_variance, hyperparameters)
    alpha = cho_solve((factor, True), readings.field - mean, check_finite=False)
    return Posterior(hyperparameters, centre, y, alpha, noise_variance, inverted(factor))


def factorise(
    y: FloatArray, noise_variance: FloatArray, hyperparameters: KernelHyperparameters
) -> FloatArray:
    """Return the lower Cholesky factor of the covariance of readings, shape (M, M)."""
    K = kernel_matrix(y, y, hyperparameters.signal)
    K[np.diag_indices_from(K)] += noise_variance
    try:
        # The transpose of a symmetric matrix is itself, in the order that LAPACK overwrites.
        return np.asarray(cholesky(K.T, lower=True, overwrite_a=True, check_finite=False))
    except LinAlgError:
        raise MapError(not_definite(hyperparameters)) from None


def inverted(factor: FloatArray) -> FloatArray:
    """Return the inverse of a lower triangular matrix, which it replaces, shape (M, M)."""
    inverse, _ = dtrtri(factor, lower=1, overwrite_c=1)
    return np.asarray(inverse)
