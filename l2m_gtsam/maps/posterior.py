"""A Gaussian process: its kernel, and what it predicts near one block for batches of points."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters, not_definite
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.maps.whitener import Whitener

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
    # s^2 and the squares as summands of the exponent save passes over the matrix.
    offset = 2 * np.log(signal) - 0.5 * np.einsum("mi,mi->m", y, y)
    rows = np.column_stack([x, -0.5 * np.einsum("ni,ni->n", x, x), np.ones(len(x))])
    K = rows @ np.column_stack([y, np.ones(len(y)), offset]).T
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
        Of the readings' covariance, or None where memory is short: then it is computed again for
        each batch that asks for variances. A product with it takes a third of the time of a solve
        with the factor.
    """

    hyperparameters: KernelHyperparameters
    centre: FloatArray
    y: FloatArray
    alpha: FloatArray
    noise_variance: FloatArray
    whitener: Whitener | None

    def variance(self, points: FloatArray, room: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the posterior variance of each axis, and how far the nearest reading is.

        Parameters
        ----------
        points
            Metres, shape (N, 3).
        room
            To be written over, at least of shape (N M,).

        Returns
        -------
        tuple
            Square microtesla, shape (N,), and squares of length scales, shape (N,).
        """
        known, whitener = self.hyperparameters, self.whitener
        if whitener is None:
            whitener = Whitener.of(factorise(self.y, self.noise_variance, known))
        x = scaled(points, self.centre, known.length_scale)
        return whitener.variance(x, self.y, known.signal, room)

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
    return Posterior(hyperparameters, centre, y, alpha, noise_variance, Whitener.of(factor))


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
