"""The exact field of one tile, summed term by term: for places that no grid covers.

A basis is made for many points and all weights at once. With given weights, and a few points in
each of many tiles, loops over the terms take a tenth of the time; the sums are the same.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.dipoles import SOFT, Dipoles
from l2m_gtsam.maps.harmonic.family import Family
from l2m_gtsam.maps.harmonic.modes import Modes
from l2m_gtsam.maps.harmonic.near_sources import PointSources
from l2m_gtsam.maps.harmonic.tile import Tile

# Sums in any order and fused products: the loop over sources runs in vector registers.
FAST = {"reassoc", "contract", "nsz"}


@dataclass(frozen=True)
class Waves:
    """The harmonics of one side of a box, with their weights; see ``Modes``.

    Attributes
    ----------
    steps
        Wave numbers of one half wave along x and y in 1/m, shape (2,).
    z
        Height at which the exponential is one, metres.
    numbers
        Half waves along x and y, shape (m, 2).
    kz
        Growth with height in 1/m, shape (m,).
    weights
        Shape (m,).
    """

    steps: FloatArray
    z: float
    numbers: IntArray
    kz: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, modes: Modes, weights: FloatArray) -> "Waves":
        """Return modes with weights."""
        return cls(np.pi / modes.size, modes.z, modes.numbers, modes.kz, weights)

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.numbers.nbytes + self.kz.nbytes + self.weights.nbytes

    def add_to(self, points: FloatArray, field: FloatArray, gradient: FloatArray) -> None:
        """Add field in uT and gradient in uT/m at points (N, 3) to those of other terms."""
        add_waves(points, self.steps, self.z, self.numbers, self.kz, self.weights, field, gradient)


@dataclass(frozen=True)
class TermSum:
    """All terms of a tile, in its own frame.

    Attributes
    ----------
    waves
        Floor and ceiling.
    sources
        All dipoles.
    others
        Families that are neither, with their weights.
    """

    waves: tuple[Waves, ...]
    sources: PointSources
    others: tuple[tuple[Family, FloatArray], ...]

    @classmethod
    def of(cls, tile: Tile, sources: PointSources) -> "TermSum":
        """Return the terms of a tile with the mean of its weights, and all of its dipoles."""
        families = [
            (family, tile.weights.mean[columns])
            for family, columns in zip(tile.basis.families, tile.basis.columns, strict=True)
        ]
        return cls(
            tuple(Waves.of(family, w) for family, w in families if isinstance(family, Modes)),
            sources,
            tuple(each for each in families if not isinstance(each[0], Modes | Dipoles)),
        )

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        sources = self.sources.positions.nbytes + self.sources.moments.nbytes
        return sources + sum(waves.nbytes for waves in self.waves)

    def field_and_gradient(self, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m in the tile's frame."""
        field, gradient = np.zeros((len(local), 3)), np.zeros((len(local), 3, 3))
        for family, weights in self.others:
            part_field, part_gradient = family.field_and_gradient(local, weights)
            field += part_field
            gradient += part_gradient
        for waves in self.waves:
            waves.add_to(local, field, gradient)
        add_dipoles(local, self.sources.positions, self.sources.moments, field, gradient)
        return field, gradient


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
    for p in range(len(cosines)):
        cosines[p], sines[p] = np.cos(p * phase), np.sin(p * phase)


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


@njit(cache=True, nogil=True, inline="always")
def add_symmetric(
    n: int,
    bx: float,
    by: float,
    bz: float,
    xx: float,
    yy: float,
    zz: float,
    xy: float,
    xz: float,
    yz: float,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add a field and its symmetric gradient to those of a point."""
    field[n, 0] += bx
    field[n, 1] += by
    field[n, 2] += bz
    gradient[n, 0, 0] += xx
    gradient[n, 1, 1] += yy
    gradient[n, 2, 2] += zz
    gradient[n, 0, 1] += xy
    gradient[n, 1, 0] += xy
    gradient[n, 0, 2] += xz
    gradient[n, 2, 0] += xz
    gradient[n, 1, 2] += yz
    gradient[n, 2, 1] += yz
