"""Field and gradient of all waves of one side of a box, point by point; see ``modes``."""

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.symmetric import FAST, add_symmetric


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_waves(
    points: FloatArray,
    steps: FloatArray,
    z: float,
    numbers: IntArray,
    kz: FloatArray,
    weights: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the field and gradient of all waves at points (N, 3); see ``Modes``."""
    p_most, q_most = 0, 0
    for m in range(len(numbers)):
        p_most, q_most = max(p_most, numbers[m, 0]), max(q_most, numbers[m, 1])
    cos_x, sin_x = np.empty(p_most + 1), np.empty(p_most + 1)
    cos_y, sin_y = np.empty(q_most + 1), np.empty(q_most + 1)
    for n in range(len(points)):
        write_phases(points[n, 0] * steps[0], cos_x, sin_x)
        write_phases(points[n, 1] * steps[1], cos_y, sin_y)
        bx = by = bz = xx = yy = zz = xy = xz = yz = 0.0
        for m in range(len(numbers)):
            p, q = numbers[m, 0], numbers[m, 1]
            kx, ky, k = p * steps[0], q * steps[1], kz[m]
            w = weights[m] * np.exp((points[n, 2] - z) * k)
            cc, sc = w * cos_x[p] * cos_y[q], w * kx * sin_x[p] * cos_y[q]
            cs, ss = w * ky * cos_x[p] * sin_y[q], w * kx * ky * sin_x[p] * sin_y[q]
            bx -= sc
            by -= cs
            bz += k * cc
            xx -= kx * kx * cc
            yy -= ky * ky * cc
            zz += k * k * cc
            xy += ss
            xz -= k * sc
            yz -= k * cs
        add_symmetric(n, bx, by, bz, xx, yy, zz, xy, xz, yz, field, gradient)


@njit(cache=True, nogil=True)
def write_phases(phase: float, cosines: FloatArray, sines: FloatArray) -> None:
    """Write the cosine and sine of all multiples of a phase."""
    cosines[0], sines[0] = 1.0, 0.0
    c, s = np.cos(phase), np.sin(phase)
    for p in range(1, len(cosines)):
        cosines[p], sines[p] = turned(cosines[p - 1], sines[p - 1], c, s)


@njit(cache=True, nogil=True, inline="always")
def turned(cosine: float, sine: float, c: float, s: float) -> tuple[float, float]:
    """Return the cosine and sine of an angle turned by another.

    A multiple by so many turns is as exact as that many roundings, far cheaper than a cosine.
    """
    return cosine * c - sine * s, sine * c + cosine * s
