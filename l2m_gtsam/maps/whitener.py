"""Posterior variances of a Gaussian process at batches of points, without Python's lock.

    var_i = s^2 - |W k_i|^2,    W^T W = K^-1,    k_ij = s^2 exp(-|x_i - y_j|^2 / 2)

(Rasmussen and Williams 2006, equation 2.26, as a sum of squares.) A drive asks for a few points of
each of many blocks: then reading W takes as long as the products with it, and both cores read.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg.lapack import dtrtri

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.exponential import FAST, LEAST, exponentiate

STRIPE = 64  # rows of a whitener that are multiplied at once


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
