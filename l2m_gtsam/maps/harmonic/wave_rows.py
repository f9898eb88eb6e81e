"""The field of waves at many points, one wave after the other; see ``modes``."""

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.wave_sum import turned


def wave_table(phase: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return cosines and sines of the first multiples of phases (N,), from 0, shapes (count, N)."""
    cosines, sines = np.empty((count, len(phase))), np.empty((count, len(phase)))
    write_multiples(np.cos(phase), np.sin(phase), cosines, sines)
    return cosines, sines


@njit(cache=True, nogil=True)
def write_multiples(c: FloatArray, s: FloatArray, cosines: FloatArray, sines: FloatArray) -> None:
    """Write cosines and sines of multiples of phases with these, (N,); see ``turned``."""
    for n in range(len(c)):
        cosines[0, n], sines[0, n] = 1.0, 0.0
    for p in range(1, len(cosines)):
        for n in range(len(c)):
            cosines[p, n], sines[p, n] = turned(cosines[p - 1, n], sines[p - 1, n], c[n], s[n])


@njit(cache=True, nogil=True)
def write_wave_rows(
    cos_x: FloatArray,
    sin_x: FloatArray,
    cos_y: FloatArray,
    sin_y: FloatArray,
    numbers: IntArray,
    growth: FloatArray,
    which: IntArray,
    factors: FloatArray,
    rows: FloatArray,
) -> None:
    """Write the field of modes, one mode after the other.

    Parameters
    ----------
    cos_x, sin_x, cos_y, sin_y
        By half waves and points, shapes (p, N) and (q, N).
    numbers
        Half waves of each mode, shape (m, 2).
    growth, which
        Exponentials by growth and points, shape (d, N), and which of them a mode has, shape (m,).
    factors
        Of each mode's field along x, y and z, shape (3, m).
    rows
        Field in uT, shape (m, 3, N).
    """
    for m in range(len(numbers)):
        p, q = numbers[m, 0], numbers[m, 1]
        cx, sx, cy, sy, e = cos_x[p], sin_x[p], cos_y[q], sin_y[q], growth[which[m]]
        write_product(sx, cy, e, factors[0, m], rows[m, 0])
        write_product(cx, sy, e, factors[1, m], rows[m, 1])
        write_product(cx, cy, e, factors[2, m], rows[m, 2])


@njit(cache=True, nogil=True, inline="always")
def write_product(
    x: FloatArray, y: FloatArray, e: FloatArray, factor: float, row: FloatArray
) -> None:
    """Write the product of three functions and a factor at points, all of shape (N,).

    One row at a time: among more arrays loops would not run in vector registers.
    """
    for n in range(len(e)):
        row[n] = x[n] * e[n] * y[n] * factor
