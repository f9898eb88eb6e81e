r"""Floor and ceiling: the harmonics of a box, for sources below and above all readings.

.. math::
    \phi = \cos(k_x x) \cos(k_y y) \, e^{\mp k z}, \quad k = \sqrt{k_x^2 + k_y^2}

with ``k_x, k_y`` multiples of pi over the box's edges, minus for sources below. The prior
variance of a weight (design of this map, section "The model") is that of a random sheet of
sources at depth h:

.. math::
    s^2 (2h)^3 \, 2\pi \, \frac{e^{-2kh}}{k} \, \frac{\nu}{L_x L_y}

with ``nu`` = 4, or 2 where one of the wave numbers vanishes. For a box without end its potential
has the covariance ``s^2 (2h)^3 / sqrt(rho^2 + (z + z' + 2h)^2)`` at horizontal distance rho.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.family import WeightPrior, features_of
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters

FLOOR, CEILING = "floor", "ceiling"


@dataclass(frozen=True)
class Waves:
    """Products of the modes' factors at N points, each of shape (N, m)."""

    cc: FloatArray
    sc: FloatArray
    cs: FloatArray
    ss: FloatArray


@dataclass(frozen=True)
class Modes:
    """Harmonics of one side of a box.

    Attributes
    ----------
    side
        FLOOR or CEILING.
    size
        Edges of the box in metres, shape (2,).
    z
        Height at which the exponential is one: that of the lowest or highest reading, metres.
    numbers
        Half waves along x and y of each mode, shape (m, 2).
    """

    side: str
    size: FloatArray
    z: float
    numbers: IntArray

    def __len__(self) -> int:
        return len(self.numbers)

    @cached_property
    def kx(self) -> FloatArray:
        """Wave numbers along x in 1/m, shape (m,)."""
        return np.asarray(np.pi * self.numbers[:, 0] / self.size[0])

    @cached_property
    def ky(self) -> FloatArray:
        """Wave numbers along y in 1/m, shape (m,)."""
        return np.asarray(np.pi * self.numbers[:, 1] / self.size[1])

    @cached_property
    def kz(self) -> FloatArray:
        """Growth with height in 1/m, shape (m,): negative for the floor."""
        sign = -1.0 if self.side == FLOOR else 1.0
        return np.asarray(sign * np.hypot(self.kx, self.ky))

    def prior(self, hyperparameters: Hyperparameters) -> WeightPrior:
        """Return the prior of the weights; see ``Family``."""
        scale = getattr(hyperparameters, f"{self.side}_scale")
        h = getattr(hyperparameters, f"{self.side}_depth")
        k = np.abs(self.kz)
        log_variance = 2 * np.log(scale) + 3 * np.log(2 * h) - 2 * k * h - np.log(k)
        return WeightPrior(
            log_variance + self._log_share,
            {
                f"{self.side}_scale": np.full(len(k), 2.0),
                f"{self.side}_depth": 3.0 - 2.0 * k * h,
            },
        )

    @cached_property
    def _growths(self) -> tuple[FloatArray, IntArray]:
        """Different growths with height in 1/m, shape (d,), and which a mode has, shape (m,)."""
        kz, which = np.unique(self.kz, return_inverse=True)
        return kz, which

    def _tables(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return cosines and sines along x, then along y, by half waves, shapes (p, N), (q, N)."""
        most = self.numbers.max(axis=0) + 1
        x, y = (
            np.arange(most[axis])[:, None] * (np.pi * points[:, axis] / self.size[axis])
            for axis in (0, 1)
        )
        return np.cos(x), np.sin(x), np.cos(y), np.sin(y)

    @cached_property
    def _log_share(self) -> FloatArray:
        """Logarithm of a mode's share in the box, shape (m,)."""
        share = np.where((self.numbers == 0).any(axis=1), 2.0, 4.0) / np.prod(self.size)
        return np.asarray(np.log(2 * np.pi * share))

    def features(self, points: FloatArray) -> FloatArray:
        """Return the field of each mode; see ``Family``."""
        return features_of(self, points)

    def write_rows(self, points: FloatArray, units: FloatArray, rows: FloatArray) -> None:
        """Write the field of so many units of each mode; see ``Family``."""
        kz, which = self._growths
        growth = np.exp(kz[:, None] * (points[:, 2] - self.z))
        factors = np.stack([-self.kx, -self.ky, self.kz]) * units
        write_wave_rows(*self._tables(points), self.numbers, growth, which, factors, rows)

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient; see ``Family``."""
        waves, kx, ky, kz = self._waves(points), self.kx, self.ky, self.kz
        w = weights
        by_z, xx, yy = (waves.cc @ np.column_stack([kz * w, -kx * kx * w, -ky * ky * w])).T
        by_x, xz = (waves.sc @ np.column_stack([-kx * w, -kx * kz * w])).T
        by_y, yz = (waves.cs @ np.column_stack([-ky * w, -ky * kz * w])).T
        xy = waves.ss @ (kx * ky * w)
        gradient = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, -xx - yy], axis=-1)
        return np.stack([by_x, by_y, by_z], axis=-1), gradient.reshape(-1, 3, 3)

    def potential(self, points: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the potential; see ``Family``."""
        return np.asarray(self._waves(points).cc @ weights)

    def potential_on(
        self, x: FloatArray, y: FloatArray, z: FloatArray, weights: FloatArray
    ) -> FloatArray:
        """Return the potential in uT m at the nodes of these axes, shape (nx, ny, nz)."""
        p, q = self.numbers.T
        most = self.numbers.max(axis=0) + 1
        table = np.zeros((*most, len(z)))
        table[p, q] = weights[:, None] * np.exp(self.kz[:, None] * (z - self.z))
        cos_x, cos_y = (
            np.cos(np.pi * place[:, None] / self.size[axis] * np.arange(most[axis]))
            for axis, place in ((0, x), (1, y))
        )
        along_y = (cos_y @ table).reshape(most[0], -1)
        return np.asarray((cos_x @ along_y).reshape(len(x), len(y), len(z)))

    def _waves(self, points: FloatArray) -> Waves:
        most = self.numbers.max(axis=0) + 1
        phase_x, phase_y = (
            np.pi * points[:, axis, None] / self.size[axis] * np.arange(most[axis])
            for axis in (0, 1)
        )
        e = np.exp((points[:, 2] - self.z)[:, None] * self.kz)
        p, q = self.numbers.T
        cx, sx = np.cos(phase_x).take(p, axis=1), np.sin(phase_x).take(p, axis=1)
        cy, sy = np.cos(phase_y).take(q, axis=1), np.sin(phase_y).take(q, axis=1)
        cx *= e
        sx *= e
        return Waves(cx * cy, sx * cy, cx * sy, sx * sy)


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


def modes_up_to(side: str, size: FloatArray, z: float, k_max: float) -> Modes:
    """Return all modes of a box whose wave number does not exceed ``k_max`` in 1/m."""
    highest = np.floor(k_max * size / np.pi).astype(np.int64)
    p, q = np.meshgrid(np.arange(highest[0] + 1), np.arange(highest[1] + 1), indexing="ij")
    k = np.pi * np.hypot(p / size[0], q / size[1])
    chosen = (k <= k_max) & (k > 0)
    return Modes(side, size, z, np.column_stack([p[chosen], q[chosen]]))


def left_out(scale: float, depth: float, k_max: float, away: FloatArray) -> FloatArray:
    """Return the prior variance of Bz that modes beyond ``k_max`` hold, in uT^2, shape (N,).

    That of Bx and of By is half as large.

    Parameters
    ----------
    scale, depth
        Of the side, in microtesla and metres.
    k_max
        Largest wave number that is kept, 1/m.
    away
        Distance of the points from the lowest (highest) reading, away from the sources, metres;
        more than -depth.
    """
    b = 2 * (depth + away)
    tail = k_max**2 / b + 2 * k_max / b**2 + 2 / b**3
    return np.asarray(scale**2 * (2 * depth) ** 3 * np.exp(-k_max * b) * tail)
