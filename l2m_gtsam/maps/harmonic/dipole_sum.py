"""Field and gradient of all dipoles, point by point; see ``dipoles``."""

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.symmetric import FAST, add_symmetric

SOFT = 1e-3  # metres


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_dipoles(
    points: FloatArray,
    positions: FloatArray,
    moments: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the field and gradient of all dipoles at points (N, 3); see ``Dipoles``."""
    for n in range(len(points)):
        bx = by = bz = xx = yy = zz = xy = xz = yz = 0.0
        for k in range(len(positions)):
            x, y = points[n, 0] - positions[k, 0], points[n, 1] - positions[k, 1]
            z = points[n, 2] - positions[k, 2]
            mx, my, mz = moments[k, 0], moments[k, 1], moments[k, 2]
            # At a source itself the field is not finite; a map must be.
            inverse = 1.0 / max(x * x + y * y + z * z, SOFT * SOFT)
            cube = inverse * np.sqrt(inverse)
            fifth = 3.0 * cube * inverse
            pull = (mx * x + my * y + mz * z) * fifth
            steep = -5.0 * pull * inverse
            bx += x * pull - cube * mx
            by += y * pull - cube * my
            bz += z * pull - cube * mz
            xx += pull + (2.0 * fifth * mx + steep * x) * x
            yy += pull + (2.0 * fifth * my + steep * y) * y
            zz += pull + (2.0 * fifth * mz + steep * z) * z
            xy += fifth * (x * my + mx * y) + steep * x * y
            xz += fifth * (x * mz + mx * z) + steep * x * z
            yz += fifth * (y * mz + my * z) + steep * y * z
        add_symmetric(n, bx, by, bz, xx, yy, zz, xy, xz, yz, field, gradient)
