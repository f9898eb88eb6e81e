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

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.family import WeightPrior
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
    def _log_share(self) -> FloatArray:
        """Logarithm of a mode's share in the box, shape (m,)."""
        share = np.where((self.numbers == 0).any(axis=1), 2.0, 4.0) / np.prod(self.size)
        return np.asarray(np.log(2 * np.pi * share))

    def features(self, points: FloatArray) -> FloatArray:
        """Return the field of each mode; see ``Family``."""
        waves = self._waves(points)
        F = np.empty((len(points), 3, len(self)))
        np.multiply(waves.sc, -self.kx, out=F[:, 0])
        np.multiply(waves.cs, -self.ky, out=F[:, 1])
        np.multiply(waves.cc, self.kz, out=F[:, 2])
        return F

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
