r"""Sources at the positions of steel: point dipoles, in combinations that readings can see.

.. math::
    \phi = -\frac{m \cdot r}{r^3}, \quad B = \frac{3 r (m \cdot r)}{r^5} - \frac{m}{r^3}

with moments m in uT m^3.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.maps.harmonic.family import Hyperparameters, WeightPrior
from l2m_gtsam.maps.harmonic.triangular import FAST, add_symmetric

SOFT = 1e-3  # metres


@dataclass(frozen=True)
class Dipoles:
    """Sources of one structure.

    Attributes
    ----------
    positions
        Sources in the tile's frame in metres, shape (K, 3).
    combinations
        Orthonormal combinations of the 3 K moments, one weight each, shape (3 K, m). They leave
        out what no reading can see, so that the prior of a weight is that of a moment.
    strength
        Standard deviation of this structure's moments over the map's ``structure_scale``.
    """

    positions: FloatArray
    combinations: FloatArray
    strength: float = 1.0

    def __len__(self) -> int:
        return int(self.combinations.shape[1])

    def prior(self, hyperparameters: Hyperparameters) -> WeightPrior:
        """Return the prior of the weights; see ``Family``."""
        log_variance = 2 * np.log(hyperparameters.structure_scale * self.strength)
        count = len(self)
        return WeightPrior(np.full(count, log_variance), {"structure_scale": np.full(count, 2.0)})

    def write_rows(self, points: FloatArray, units: FloatArray, rows: FloatArray) -> None:
        """Write the field of so many units of each combination; see ``Family``."""
        moments = np.empty((3 * len(self.positions), 3, len(points)))
        write_moment_rows(points, self.positions, moments)
        mixed = (self.combinations * units).T
        flat = len(moments), 3 * len(points)
        np.matmul(mixed, moments.reshape(flat), out=rows.reshape(len(rows), flat[1]))

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return field and gradient; see ``Family``."""
        field, gradient = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
        add_dipoles(points, self.positions, self.moments(weights), field, gradient)
        return field, gradient

    def moments(self, weights: FloatArray) -> FloatArray:
        """Return the moments of the sources in uT m^3, shape (K, 3)."""
        return np.asarray((self.combinations @ weights).reshape(-1, 3))


def moment_features(points: FloatArray, sources: FloatArray) -> FloatArray:
    """Return the field of unit moments at sources, source by source, shape (N, 3, 3 K)."""
    rows = np.empty((3 * len(sources), 3, len(points)))
    write_moment_rows(points, sources, rows)
    return np.ascontiguousarray(rows.transpose(2, 1, 0))


@njit(cache=True, nogil=True, error_model="numpy")
def write_moment_rows(points: FloatArray, sources: FloatArray, rows: FloatArray) -> None:
    """Write the field of unit moments, one moment after the other, shape (3 K, 3, N)."""
    # Point after point in the inner loops: they run in vector registers.
    count = len(points)
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    r, fifth, cube = np.empty((3, count)), np.empty(count), np.empty(count)
    for k in range(len(sources)):
        a, b, c = sources[k, 0], sources[k, 1], sources[k, 2]
        for n in range(count):
            r[0, n], r[1, n], r[2, n] = x[n] - a, y[n] - b, z[n] - c
            square = r[0, n] * r[0, n] + r[1, n] * r[1, n] + r[2, n] * r[2, n]
            inverse = 1.0 / max(square, SOFT * SOFT)
            cube[n] = inverse * np.sqrt(inverse)
            fifth[n] = 3.0 * cube[n] * inverse
        for j in range(3):
            for i in range(3):
                row = rows[3 * k + j, i]
                if i == j:
                    for n in range(count):
                        row[n] = fifth[n] * r[i, n] * r[j, n] - cube[n]
                else:
                    for n in range(count):
                        row[n] = fifth[n] * r[i, n] * r[j, n]


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
