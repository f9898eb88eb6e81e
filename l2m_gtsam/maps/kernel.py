"""The squared-exponential kernel on points in space, arranged so that BLAS does the work.

    k(x, y) = s^2 exp(-|x - y|^2 / 2 l^2)

All points here are *scaled*: taken from a centre near the data and divided by the length scale,
so that k = s^2 exp(x.y - |x|^2 / 2 - |y|^2 / 2). The exponent is one matrix product of five
features per point.

The three axes of the field share the kernel, hence one matrix is factorised instead of three and
the variance is isotropic: the vertical axis is usually the roughest and the sigmas of the three
are an average. The mean of each axis is a constant outside the kernel.
"""

import numpy as np

from l2m_gtsam.data import FloatArray

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
