r"""Sources so near that a grid cannot hold their field: each is split into two parts.

.. math::
    -\frac{m \cdot r}{r^3} = -(m \cdot r) \, S(r^2) - (m \cdot r) \, Q(r^2)

S is the Taylor polynomial of ``s^(-3/2)`` about ``r0^2`` for ``s < r0^2``, and ``s^(-3/2)``
itself beyond. The first part is smooth everywhere, also at the source, and goes into a grid. The
second is zero beyond ``r0`` and is added to what the grid says, source by source. The split is
exact.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.special import binom

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.potential_grid import Lattice

ORDER = 7  # of the polynomial: the smooth part is as smooth as the grid's spline
TAYLOR = binom(-1.5, np.arange(ORDER + 1))  # of (1 + t)^(-3/2)
CELL = 0.25  # metres: edge of the cells, in x and y, that know the sources within reach

# Sums in any order, fused products, and reciprocals: the loops run in vector registers.
FAST = {"reassoc", "contract", "nsz", "arcp"}


@dataclass(frozen=True)
class PointSources:
    """Dipoles with known moments.

    Attributes
    ----------
    positions
        Metres, shape (K, 3).
    moments
        uT m^3, shape (K, 3).
    """

    positions: FloatArray
    moments: FloatArray

    def __len__(self) -> int:
        return len(self.positions)

    def smooth_potential(self, lattice: Lattice, radius: float) -> FloatArray:
        """Return the smooth part of the potential at the nodes in uT m, shape (nx, ny, nz).

        Only columns with a node that is needed are computed, the others are zero.
        """
        phi = np.zeros(lattice.needed.shape)
        if len(self):
            columns = np.asarray(lattice.needed.any(axis=2))
            add_smooth(*lattice.axes, columns, self.positions, self.moments, radius, phi)
        return phi


@dataclass(frozen=True)
class NearSources:
    """The parts of sources that end at a radius, sorted by the cells in which they are felt.

    Attributes
    ----------
    radius
        Where these parts end, in metres.
    corner
        Lower corner of the cells in metres, shape (2,).
    shape
        Number of cells along x and y.
    starts
        Where each cell starts in ``table``, shape (nx ny + 1,).
    table
        Positions and moments (x, y, z, mx, my, mz) of the sources within the radius of a cell,
        cell by cell, shape (6, E).
    """

    radius: float
    corner: FloatArray
    shape: tuple[int, int]
    starts: IntArray
    table: FloatArray

    def add_to(self, points: FloatArray, field: FloatArray, gradient: FloatArray) -> None:
        """Add field in uT and gradient in uT/m at points (N, 3) to those of the smooth part."""
        if self.table.size:
            add_near(
                points,
                self.corner,
                self.shape,
                self.starts,
                self.table,
                self.radius,
                field,
                gradient,
            )


def near_sources(
    sources: PointSources, lower: FloatArray, upper: FloatArray, radius: float
) -> NearSources:
    """Return the near parts for places in a rectangle (corners (2,), metres)."""
    nx, ny = (int(count) for count in np.floor((upper - lower) / CELL) + 1)
    gaps = []
    for axis, count in ((0, nx), (1, ny)):
        left = lower[axis] + CELL * np.arange(count)[:, None]
        place = sources.positions[:, axis]
        gaps.append(np.maximum(np.maximum(left - place, place - left - CELL), 0.0))
    near = np.hypot(gaps[0][:, None], gaps[1]) < radius
    starts = np.append(0, np.cumsum(near.sum(axis=2)))
    members = np.nonzero(near)[2]
    table = np.vstack([sources.positions[members].T, sources.moments[members].T])
    return NearSources(radius, lower, (nx, ny), starts, np.ascontiguousarray(table))


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_smooth(
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    columns: BoolArray,
    positions: FloatArray,
    moments: FloatArray,
    radius: float,
    phi: FloatArray,
) -> None:
    """Add the smooth part of all sources to the potential of the columns that are asked for."""
    edge = radius * radius
    for i in range(len(x)):
        for j in range(len(y)):
            if not columns[i, j]:
                continue
            out = phi[i, j]
            for k in range(len(positions)):
                dx, dy = x[i] - positions[k, 0], y[j] - positions[k, 1]
                flat = dx * dx + dy * dy
                level = moments[k, 0] * dx + moments[k, 1] * dy
                if flat >= edge:
                    for c in range(len(z)):
                        dz = z[c] - positions[k, 2]
                        s = flat + dz * dz
                        out[c] -= (level + moments[k, 2] * dz) / (s * np.sqrt(s))
                    continue
                for c in range(len(z)):
                    dz = z[c] - positions[k, 2]
                    s = max(flat + dz * dz, edge)
                    t = min((flat + dz * dz) / edge - 1, 0.0)
                    inner = TAYLOR[ORDER]
                    for p in range(ORDER - 1, -1, -1):
                        inner = inner * t + TAYLOR[p]
                    # Beyond the radius t is 0 and the polynomial 1; within, s is the edge.
                    out[c] -= (level + moments[k, 2] * dz) * inner / (s * np.sqrt(s))


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_near(
    points: FloatArray,
    corner: FloatArray,
    shape: tuple[int, int],
    starts: IntArray,
    table: FloatArray,
    radius: float,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the near part of the sources at points (N, 3)."""
    edge = radius * radius
    scale = 1 / (radius * edge)
    px, py, pz, ux, uy, uz = table
    for n in range(len(points)):
        across, along = (points[n, 0] - corner[0]) / CELL, (points[n, 1] - corner[1]) / CELL
        if not (0 <= across < shape[0] and 0 <= along < shape[1]):
            continue
        cell = int(across) * shape[1] + int(along)
        bx = by = bz = xx = yy = zz = xy = xz = yz = 0.0
        for e in range(starts[cell], starts[cell + 1]):
            x, y, z = points[n, 0] - px[e], points[n, 1] - py[e], points[n, 2] - pz[e]
            # At the edge all that follows vanishes to rounding, so that no branch is needed.
            s = min(x * x + y * y + z * z, edge)
            # S and its derivatives by s over the powers of the edge, by Horner's rule.
            t = s / edge - 1
            value, slope, half_curvature = TAYLOR[ORDER], 0.0, 0.0
            for p in range(ORDER - 1, -1, -1):
                half_curvature = half_curvature * t + slope
                slope = slope * t + value
                value = value * t + TAYLOR[p]
            inverse = 1 / s
            cube = inverse * np.sqrt(inverse)
            q0 = cube - scale * value
            q1 = -1.5 * cube * inverse - scale / edge * slope
            q2 = 3.75 * cube * inverse * inverse - scale / (edge * edge) * 2 * half_curvature
            mx, my, mz = ux[e], uy[e], uz[e]
            mr = mx * x + my * y + mz * z
            a, b, c = 2 * q1, 2 * mr * q1, 4 * mr * q2
            bx -= mx * q0 + b * x
            by -= my * q0 + b * y
            bz -= mz * q0 + b * z
            xx -= b + (2 * a * mx + c * x) * x
            yy -= b + (2 * a * my + c * y) * y
            zz -= b + (2 * a * mz + c * z) * z
            xy -= a * (mx * y + my * x) + c * x * y
            xz -= a * (mx * z + mz * x) + c * x * z
            yz -= a * (my * z + mz * y) + c * y * z
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
