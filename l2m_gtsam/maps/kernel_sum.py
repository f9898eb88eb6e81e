"""Posterior means of Gaussian processes on blocks, point by point; see ``posterior``.

    mean_i     = sum_j k_j alpha_ji,    k_j = exp(-|x - y_j|^2 / 2)
    dmean_i/dx = -(1/l) sum_j (x - y_j) k_j alpha_ji

A solve asks for the same few hundred places again and again, a few of them in each block: for these
matrix products are too small. The loops are such that a compiler makes vector instructions of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.posterior import FAST, LEAST, Posterior, exponentiate, scaled


@dataclass(frozen=True)
class KernelSums:
    """The processes of all blocks.

    Attributes
    ----------
    length_scale
        Length scale of the kernel in metres.
    centres
        Origins of the blocks' scaled points in metres, shape (B, 3).
    first
        Where the training points of each block begin, and where the last end, shape (B + 1,).
    y
        Scaled training points of all blocks, shape (3, M).
    alpha
        Their weights in uT, shape (3, M).
    """

    length_scale: float
    centres: FloatArray
    first: IntArray
    y: FloatArray
    alpha: FloatArray

    @classmethod
    def of(cls, blocks: Sequence[Posterior]) -> "KernelSums":
        """Return the sums of these blocks, which share hyperparameters."""
        known = blocks[0].hyperparameters
        alpha = known.signal**2 * np.concatenate([block.alpha for block in blocks])
        return cls(
            length_scale=known.length_scale,
            centres=np.stack([block.centre for block in blocks]),
            first=np.cumsum([0, *(len(block.y) for block in blocks)]),
            y=np.ascontiguousarray(np.concatenate([block.y for block in blocks]).T),
            alpha=np.ascontiguousarray(alpha.T),
        )

    def mean_and_gradient(
        self, points: FloatArray, block: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mean (N, 3) in uT without its constant and its gradient (N, 3, 3) in uT/m.

        Parameters
        ----------
        points
            Metres, shape (N, 3).
        block
            Which block answers for each, shape (N,).
        """
        x = scaled(points, self.centres[block], self.length_scale)
        mean, gradient = np.empty((len(x), 3)), np.empty((len(x), 3, 3))
        write_sums(x, block, self.first, self.y, self.alpha, mean, gradient)
        return mean, gradient / self.length_scale


@njit(cache=True, nogil=True)
def write_sums(
    x: FloatArray,
    block: IntArray,
    first: IntArray,
    y: FloatArray,
    alpha: FloatArray,
    mean: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the means (N, 3) and their gradients by scaled points (N, 3); see ``KernelSums``."""
    most = np.max(first[1:] - first[:-1])
    exponents, powers = np.empty(most), np.empty(most)
    for n in range(len(x)):
        start, end = first[block[n]], first[block[n] + 1]
        k, power = exponents[: end - start], powers[: end - start]
        # Row by row: of a piece of a matrix the compiler does not know that rows are contiguous.
        y0, y1, y2 = y[0, start:end], y[1, start:end], y[2, start:end]
        a0, a1, a2 = alpha[0, start:end], alpha[1, start:end], alpha[2, start:end]
        write_exponents(x[n], y0, y1, y2, k)
        exponentiate(k, power, power.view(np.int64))
        write_sum(x[n], y0, y1, y2, a0, a1, a2, k, mean[n], gradient[n])


@njit(cache=True, nogil=True, fastmath=FAST)
def write_exponents(
    x: FloatArray, y0: FloatArray, y1: FloatArray, y2: FloatArray, exponents: FloatArray
) -> None:
    """Write ``-|x - y|^2 / 2`` of one point and all training points, shape (M,)."""
    for j in range(len(exponents)):
        d0, d1, d2 = x[0] - y0[j], x[1] - y1[j], x[2] - y2[j]
        exponents[j] = max(-0.5 * (d0 * d0 + d1 * d1 + d2 * d2), LEAST)


@njit(cache=True, nogil=True, fastmath=FAST)
def write_sum(
    x: FloatArray,
    y0: FloatArray,
    y1: FloatArray,
    y2: FloatArray,
    a0: FloatArray,
    a1: FloatArray,
    a2: FloatArray,
    k: FloatArray,
    mean: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the mean (3,) at one point and its gradient (3, 3) by the scaled point."""
    b0 = b1 = b2 = 0.0
    g00 = g01 = g02 = g10 = g11 = g12 = g20 = g21 = g22 = 0.0
    for j in range(len(k)):
        d0, d1, d2 = y0[j] - x[0], y1[j] - x[1], y2[j] - x[2]
        w0, w1, w2 = k[j] * a0[j], k[j] * a1[j], k[j] * a2[j]
        b0 += w0
        b1 += w1
        b2 += w2
        g00 += w0 * d0
        g01 += w0 * d1
        g02 += w0 * d2
        g10 += w1 * d0
        g11 += w1 * d1
        g12 += w1 * d2
        g20 += w2 * d0
        g21 += w2 * d1
        g22 += w2 * d2
    mean[0], mean[1], mean[2] = b0, b1, b2
    gradient[0, 0], gradient[0, 1], gradient[0, 2] = g00, g01, g02
    gradient[1, 0], gradient[1, 1], gradient[1, 2] = g10, g11, g12
    gradient[2, 0], gradient[2, 1], gradient[2, 2] = g20, g21, g22
