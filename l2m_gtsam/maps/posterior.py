"""A Gaussian process: its kernel, and what it predicts near one block for batches of points.

Variances take no lock of Python's:

    var_i = s^2 - |W k_i|^2,    W^T W = K^-1,    k_ij = s^2 exp(-|x_i - y_j|^2 / 2)

(Rasmussen and Williams 2006, equation 2.26, as a sum of squares.) A drive asks for a few points of
each of many blocks: then reading W takes as long as the products with it, and both cores read.
"""

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.linalg import LinAlgError, cho_solve, cholesky
from scipy.linalg.lapack import dtrtri

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.hyperparameters import KernelHyperparameters, not_definite
from l2m_gtsam.maps.training import TrainingSet

FURTHEST = 1e6
"""Points are pulled to this distance, in length scales, where every kernel is zero anyway."""
STRIPE = 64  # rows of a whitener that are multiplied at once
# For loops that a compiler makes vector instructions of.
FAST = {"reassoc", "contract", "nsz"}
LEAST = -700.0  # an exponent of which float64 still has the power
LOG2_E = 1.4426950408889634
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
# Added to a number, the lowest bits of its mantissa are the nearest whole number plus the bias of
# float64's exponents; shifted there they are its power of two.
EXPONENT = 1.5 * 2.0**52 + 1023
MANTISSA = 52


@njit(cache=True, nogil=True, fastmath={"contract"})
def exponentiate(values: FloatArray, powers: FloatArray, bits: IntArray) -> None:
    """Put exp(v) in the place of each v from ``LEAST`` to 0, to 3e-16 of it.

    It is 2^n exp(r) with n whole and |r| below ln(2) / 2, where a Taylor series is enough. The
    mathematical library's would be called for one value after the other.

    Parameters
    ----------
    values
        Shape (M,).
    powers, bits
        Room for the powers of two, and the same room as whole numbers, shape (M,).
    """
    for j in range(len(values)):
        powers[j] = values[j] * LOG2_E + EXPONENT
        n = powers[j] - EXPONENT
        r = (values[j] - n * LN2_HIGH) - n * LN2_LOW
        p = 1 / 479001600
        p = p * r + 1 / 39916800
        p = p * r + 1 / 3628800
        p = p * r + 1 / 362880
        p = p * r + 1 / 40320
        p = p * r + 1 / 5040
        p = p * r + 1 / 720
        p = p * r + 1 / 120
        p = p * r + 1 / 24
        p = p * r + 1 / 6
        p = p * r + 1 / 2
        p = p * r + 1
        values[j] = p * r + 1
    for j in range(len(values)):
        bits[j] = bits[j] << MANTISSA
    for j in range(len(values)):
        values[j] *= powers[j]


@dataclass(frozen=True)
class Whitener:
    """Inverse W of the lower Cholesky factor of the covariance of M readings.

    Attributes
    ----------
    entries
        Stripes of ``STRIPE`` of its rows in 1/uT, one after the other, each of them row by row up
        to the column where the diagonal leaves it, shape (E,). They take little more than half of
        the whole.
    first
        Where each stripe begins, and where the last one ends, shape (S + 1,).
    """

    entries: FloatArray
    first: IntArray

    @classmethod
    def of(cls, factor: FloatArray) -> "Whitener":
        """Invert a lower Cholesky factor, shape (M, M) in uT, which is overwritten."""
        inverse, _ = dtrtri(factor, lower=1, overwrite_c=1)
        starts = range(0, len(inverse), STRIPE)
        stripes = [inverse[start : start + STRIPE, : start + STRIPE].ravel() for start in starts]
        first = np.cumsum([0, *(stripe.size for stripe in stripes)])
        return cls(np.concatenate(stripes), first)

    def variance(
        self, x: FloatArray, y: FloatArray, signal: float, room: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return variances in uT^2 and squares of distances to the nearest reading, each (N,).

        Parameters
        ----------
        x
            Points in length scales, shape (N, 3).
        y
            Readings in length scales, shape (M, 3).
        signal
            Standard deviation of the prior in uT.
        room
            To be written over, at least of shape (N M,): memory that is asked for anew for each
            block costs a tenth of the time.
        """
        variance, nearest = np.empty(len(x)), np.empty(len(x))
        readings = np.ascontiguousarray(y.T)
        written = room, variance, nearest
        write_variances(x, readings, signal**2, self.entries, self.first, *written)
        return variance, nearest


@njit(cache=True, nogil=True)
def write_variances(
    x: FloatArray,
    y: FloatArray,
    strength: float,
    entries: FloatArray,
    first: IntArray,
    room: FloatArray,
    variance: FloatArray,
    nearest: FloatArray,
) -> None:
    """Write what ``Whitener.variance`` returns; readings have the shape (3, M) here."""
    exponents = room[: y.shape[1] * len(x)].reshape((y.shape[1], len(x)))
    power = np.empty(len(x))
    nearest[:] = -2 * LEAST
    for m in range(y.shape[1]):
        write_distances(x, y[:, m], exponents[m], nearest)
        exponentiate(exponents[m], power, power.view(np.int64))
    variance[:] = 0.0
    for stripe in range(len(first) - 1):
        start = stripe * STRIPE
        end = min(start + STRIPE, y.shape[1])
        W = entries[first[stripe] : first[stripe + 1]].reshape((end - start, end))
        add_squares(np.dot(W, exponents[:end]), variance)
    for n in range(len(x)):
        variance[n] = max(strength - strength**2 * variance[n], 0.0)


@njit(cache=True, nogil=True, fastmath=FAST)
def write_distances(
    x: FloatArray, y: FloatArray, exponents: FloatArray, nearest: FloatArray
) -> None:
    """Write ``-|x - y|^2 / 2`` of all points, (N,), and the squared distance if none was less."""
    for n in range(len(x)):
        d0, d1, d2 = x[n, 0] - y[0], x[n, 1] - y[1], x[n, 2] - y[2]
        square = d0 * d0 + d1 * d1 + d2 * d2
        nearest[n] = min(nearest[n], square)
        exponents[n] = max(-0.5 * square, LEAST)


@njit(cache=True, nogil=True, fastmath=FAST)
def add_squares(white: FloatArray, total: FloatArray) -> None:
    """Add the squares of the rows of a matrix (S, N) to a total (N,)."""
    for row in white:
        for n in range(len(total)):
            total[n] += row[n] * row[n]


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
