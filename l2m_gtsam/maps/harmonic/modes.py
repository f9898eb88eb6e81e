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
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from l2m_gtsam.data import FieldAndGradient, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.family import Hyperparameters, WeightPrior
from l2m_gtsam.maps.harmonic.triangular import FAST, add_symmetric

FLOOR, CEILING = "floor", "ceiling"


@dataclass(frozen=True)
class Modes:
    """Harmonics of one side of a box.

    Attributes
    ----------
    side
        Side of the sources: FLOOR (below) or CEILING (above).
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
        # In logarithms: exp(-2 k h) of the finest modes may underflow.
        log_variance = 2 * np.log(scale) + 3 * np.log(2 * h) - 2 * k * h - np.log(k)
        return WeightPrior(
            log_variance + self._log_share,
            {f"{self.side}_scale": np.full(len(k), 2.0), f"{self.side}_depth": 3.0 - 2.0 * k * h},
        )

    @cached_property
    def _growths(self) -> tuple[FloatArray, IntArray]:
        """Different growths with height in 1/m, shape (d,), and which a mode has, shape (m,)."""
        kz, which = np.unique(self.kz, return_inverse=True)
        return kz, which

    def _tables(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return cosines and sines along x, then along y, by half waves, shapes (p, N), (q, N)."""
        count = self.numbers.max(axis=0) + 1
        return (
            *wave_table(np.pi * points[:, 0] / self.size[0], int(count[0])),
            *wave_table(np.pi * points[:, 1] / self.size[1], int(count[1])),
        )

    @cached_property
    def _log_share(self) -> FloatArray:
        """Logarithm of a mode's share in the box, shape (m,)."""
        share = np.where((self.numbers == 0).any(axis=1), 2.0, 4.0) / np.prod(self.size)
        return np.asarray(np.log(2 * np.pi * share))

    def write_rows(self, points: FloatArray, units: FloatArray, rows: FloatArray) -> None:
        """Write the field of so many units of each mode; see ``Family``."""
        kz, which = self._growths
        growth = np.exp(kz[:, None] * (points[:, 2] - self.z))
        factors = np.stack([-self.kx, -self.ky, self.kz]) * units
        write_wave_rows(*self._tables(points), self.numbers, growth, which, factors, rows)

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return field and gradient; see ``Family``."""
        field, gradient = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
        steps = np.pi / self.size
        add_waves(points, steps, self.z, self.numbers, self.kz, weights, field, gradient)
        return field, gradient

    def by_points(self, points: FloatArray, by_features: FloatArray) -> FloatArray:
        """Return the derivative of a scalar by points, shape (N, 3).

        Parameters
        ----------
        points
            In the tile's frame in metres, shape (N, 3).
        by_features
            Its derivative by the field of a unit of each mode there, shape (N, 3, m).
        """
        found, steps = np.empty((len(points), 3)), np.pi / self.size
        write_by_points(points, steps, self.z, self.numbers, self.kz, by_features, found)
        return found

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
        # Separable: one axis after the other instead of all modes at all nodes.
        along_y = (cos_y @ table).reshape(most[0], -1)
        return np.asarray((cos_x @ along_y).reshape(len(x), len(y), len(z)))


def modes_up_to(side: str, size: FloatArray, z: float, k_max: float) -> Modes:
    """Return all modes of a box whose wave number does not exceed ``k_max`` in 1/m."""
    return Modes(side, size, z, half_waves(float(size[0]), float(size[1]), k_max))


@lru_cache(maxsize=8)  # the tiles of a map have boxes of one size
def half_waves(along_x: float, along_y: float, k_max: float) -> IntArray:
    """Return the half waves of all modes of a box of these edges in metres, shape (m, 2)."""
    size = np.array([along_x, along_y])
    highest = np.floor(k_max * size / np.pi).astype(np.int64)
    p, q = np.meshgrid(np.arange(highest[0] + 1), np.arange(highest[1] + 1), indexing="ij")
    k = np.pi * np.hypot(p / size[0], q / size[1])
    # k = 0 is a constant potential, which has no field.
    chosen = (k <= k_max) & (k > 0)
    numbers = np.column_stack([p[chosen], q[chosen]])
    numbers.setflags(write=False)
    return numbers


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
    # Spectrum of Bz, integrated by parts: k^2 exp(-k b) from k_max to infinity.
    tail = k_max**2 / b + 2 * k_max / b**2 + 2 / b**3
    return np.asarray(scale**2 * (2 * depth) ** 3 * np.exp(-k_max * b) * tail)


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


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def write_by_points(
    points: FloatArray,
    steps: FloatArray,
    z: float,
    numbers: IntArray,
    kz: FloatArray,
    by_features: FloatArray,
    found: FloatArray,
) -> None:
    """Write the derivative of a scalar by points (N, 3), of one by features; see ``Modes``."""
    p_most, q_most = 0, 0
    for m in range(len(numbers)):
        p_most, q_most = max(p_most, numbers[m, 0]), max(q_most, numbers[m, 1])
    cos_x, sin_x = np.empty(p_most + 1), np.empty(p_most + 1)
    cos_y, sin_y = np.empty(q_most + 1), np.empty(q_most + 1)
    for n in range(len(points)):
        write_phases(points[n, 0] * steps[0], cos_x, sin_x)
        write_phases(points[n, 1] * steps[1], cos_y, sin_y)
        x = y = u = 0.0
        for m in range(len(numbers)):
            p, q = numbers[m, 0], numbers[m, 1]
            kx, ky, k = p * steps[0], q * steps[1], kz[m]
            e = np.exp((points[n, 2] - z) * k)
            cc, sc = e * cos_x[p] * cos_y[q], e * kx * sin_x[p] * cos_y[q]
            cs, ss = e * ky * cos_x[p] * sin_y[q], e * kx * ky * sin_x[p] * sin_y[q]
            a, b, c = by_features[n, 0, m], by_features[n, 1, m], by_features[n, 2, m]
            x += b * ss - a * kx * kx * cc - c * k * sc
            y += a * ss - b * ky * ky * cc - c * k * cs
            u += k * (c * k * cc - a * sc - b * cs)
        found[n, 0], found[n, 1], found[n, 2] = x, y, u


# In line: a function that a fast kernel calls is compiled in that one's mode, unless it was before.
@njit(cache=True, nogil=True, inline="always")
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
