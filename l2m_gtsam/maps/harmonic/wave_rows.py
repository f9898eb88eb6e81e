"""The field of waves at many points, one wave after the other; see ``modes``."""

from numba import njit

from l2m_gtsam.data import FloatArray, IntArray


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
        Shape (m, 3, N).
    """
    for m in range(len(numbers)):
        p, q = numbers[m, 0], numbers[m, 1]
        cx, sx, cy, sy, e = cos_x[p], sin_x[p], cos_y[q], sin_y[q], growth[which[m]]
        by_x, by_y, by_z = rows[m, 0], rows[m, 1], rows[m, 2]
        ax, ay, az = factors[0, m], factors[1, m], factors[2, m]
        for n in range(len(e)):
            c, s = cx[n] * e[n], sx[n] * e[n]
            by_x[n], by_y[n], by_z[n] = s * cy[n] * ax, c * sy[n] * ay, c * cy[n] * az
