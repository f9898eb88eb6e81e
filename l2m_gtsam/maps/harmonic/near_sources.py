r"""Sources so near that a grid cannot hold their field: each is split into two parts.

.. math::
    -\frac{m \cdot r}{r^3} = -(m \cdot r) \, S(r^2) - (m \cdot r) \, Q(r^2)

S is the Taylor polynomial of ``s^(-3/2)`` about ``r0^2`` for ``s < r0^2``, and ``s^(-3/2)``
itself beyond. The first part is smooth everywhere, also at the source, and goes into a grid. The
second is zero beyond ``r0`` and is added to the grid's value, source by source. The split is
exact.

What a grid makes of the first part errs by the moment over the tenth power of ``r0``: a source a
thousand times weaker than another is split at half the radius.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.special import binom

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.potential_grid import PotentialLattice
from l2m_gtsam.maps.harmonic.triangular import add_symmetric

ORDER = 7  # of the polynomial: the smooth part is as smooth as the grid's spline
TAYLOR = binom(-1.5, np.arange(ORDER + 1))  # of (1 + t)^(-3/2)
CELL = 0.2  # metres: edge of the cells that know the sources within reach
WEAKEST = 1e-4  # of the strongest source: weaker ones are split as if they were that strong
LANES = 4  # of vector registers: a cell's list is filled up to a multiple, or its rest is slow

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

    def radii(self, radius: float) -> FloatArray:
        """Return where to split each source if the strongest is split at this radius, metres."""
        strength = np.linalg.norm(self.moments, axis=1)
        strongest = max(strength.max(initial=0.0), np.finfo(float).tiny)
        return np.asarray(radius * np.maximum(strength / strongest, WEAKEST) ** 0.1)

    def smooth_potential(self, lattice: PotentialLattice, radius: float) -> FloatArray:
        """Return the smooth part of the potential at the nodes in uT m, shape (nx, ny, nz).

        Only columns with a node that is needed are computed, the others are zero.

        Parameters
        ----------
        lattice
            Nodes of the grid in the tile's frame, metres.
        radius
            At which the strongest source is split, in metres.
        """
        phi = np.zeros(lattice.needed.shape)
        if len(self):
            columns = np.asarray(lattice.needed.any(axis=2))
            radii = self.radii(radius)
            add_smooth(*lattice.axes, columns, self.positions, self.moments, radii, phi)
        return phi


@dataclass(frozen=True)
class NearSources:
    """The parts of sources that end at a radius, sorted by the cells that they reach.

    Attributes
    ----------
    corner
        Lower corner of the cells in metres, shape (3,).
    shape
        Number of cells along x, y and z.
    starts
        Where each cell starts in ``table``, shape (nx ny nz + 1,).
    table
        Positions, moments and squared radii (x, y, z, mx, my, mz, edge, 1 / edge) of the sources
        that reach a cell, cell by cell, shape (8, E); some without a moment to fill lists up.
    """

    corner: FloatArray
    shape: tuple[int, int, int]
    starts: IntArray
    table: FloatArray

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.starts.nbytes + self.table.nbytes

    def add_to(self, points: FloatArray, field: FloatArray, gradient: FloatArray) -> None:
        """Add the near part at points.

        Parameters
        ----------
        points
            In the tile's frame in metres, shape (N, 3).
        field, gradient
            In uT and uT/m, shapes (N, 3) and (N, 3, 3); are added to.
        """
        add_near(points, self.corner, self.shape, self.starts, self.table, field, gradient)


def near_sources(
    sources: PointSources, lower: FloatArray, upper: FloatArray, radius: float
) -> NearSources:
    """Return the near parts of sources.

    Parameters
    ----------
    sources
        K dipoles in the tile's frame, metres and uT m^3.
    lower, upper
        Corners of the box in which they will be evaluated, metres, shape (3,).
    radius
        At which the strongest source is split, in metres.
    """
    edge = sources.radii(radius) ** 2
    nx, ny, nz = (int(count) for count in np.floor((upper - lower) / CELL) + 1)
    gaps = []
    for axis, count in enumerate((nx, ny, nz)):
        left = lower[axis] + CELL * np.arange(count)[:, None]
        place = sources.positions[:, axis]
        gaps.append(np.maximum(np.maximum(left - place, place - left - CELL), 0.0) ** 2)
    x, y, z = gaps
    counts = np.zeros((nx, ny, nz), dtype=np.int64)
    count_near(x, y, z, edge, counts)
    starts = np.append(0, np.cumsum(-(-counts // LANES) * LANES))
    # What fills the lists up is far away, and has no moment.
    table = np.ones((8, starts[-1]))
    table[:3], table[3:6] = lower[:, None] - 10, 0.0
    free = starts[:-1].reshape(counts.shape).copy()
    fill_near(x, y, z, edge, sources.positions, sources.moments, free, table)
    return NearSources(lower, (nx, ny, nz), starts, table)


@njit(cache=True, nogil=True)
def count_near(
    x: FloatArray, y: FloatArray, z: FloatArray, edge: FloatArray, counts: IntArray
) -> None:
    """Add up how many sources reach each cell.

    Parameters
    ----------
    x, y, z
        Squared gaps between cells and sources along each axis in m^2, shapes (nx, K) to (nz, K).
    edge
        Squared radii of the sources in m^2, shape (K,).
    counts
        Number of sources per cell, shape (nx, ny, nz); added to.
    """
    nx, ny, nz = counts.shape
    for k in range(len(edge)):
        for i in range(nx):
            for j in range(ny):
                if x[i, k] + y[j, k] < edge[k]:
                    for c in range(nz):
                        counts[i, j, c] += x[i, k] + y[j, k] + z[c, k] < edge[k]


@njit(cache=True, nogil=True)
def fill_near(
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    edge: FloatArray,
    positions: FloatArray,
    moments: FloatArray,
    free: IntArray,
    table: FloatArray,
) -> None:
    """Write each source into the lists of the cells that it reaches; see ``count_near``.

    Parameters
    ----------
    x, y, z, edge
        Squared gaps and radii in m^2, shapes as in ``count_near``.
    positions, moments
        Of the sources, shape (K, 3).
    free
        The next free column of each cell's list, shape (nx, ny, nz); moves on.
    table
        Lists; see ``NearSources``.
    """
    nx, ny, nz = free.shape
    for k in range(len(edge)):
        for i in range(nx):
            for j in range(ny):
                if x[i, k] + y[j, k] < edge[k]:
                    for c in range(nz):
                        if x[i, k] + y[j, k] + z[c, k] < edge[k]:
                            at = free[i, j, c]
                            free[i, j, c] += 1
                            for axis in range(3):
                                table[axis, at] = positions[k, axis]
                                table[3 + axis, at] = moments[k, axis]
                            table[6, at], table[7, at] = edge[k], 1 / edge[k]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_smooth(
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    columns: BoolArray,
    positions: FloatArray,
    moments: FloatArray,
    radii: FloatArray,
    phi: FloatArray,
) -> None:
    """Add the smooth part of all sources to the potential of the columns that are asked for."""
    far = np.empty((4, len(positions)))
    flats, levels, heights, uprights = far
    for i in range(len(x)):
        for j in range(len(y)):
            if not columns[i, j]:
                continue
            out = phi[i, j]
            count = 0
            for k in range(len(positions)):
                dx, dy = x[i] - positions[k, 0], y[j] - positions[k, 1]
                flat = dx * dx + dy * dy
                edge = radii[k] * radii[k]
                level = moments[k, 0] * dx + moments[k, 1] * dy
                if flat >= edge:
                    flats[count], levels[count] = flat, level
                    heights[count], uprights[count] = positions[k, 2], moments[k, 2]
                    count += 1
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
            add_far(z, flats[:count], levels, heights, uprights, out)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy", inline="always")
def add_far(
    z: FloatArray,
    flats: FloatArray,
    levels: FloatArray,
    heights: FloatArray,
    uprights: FloatArray,
    out: FloatArray,
) -> None:
    """Add the potential of sources to a column that none of them is near.

    Parameters
    ----------
    z
        Heights of the nodes in metres, shape (n,).
    flats
        Squared horizontal distances of the sources in m^2, shape (k,).
    levels, heights, uprights
        Horizontal part of ``m . r``, height and vertical moment of each, shape (k,) or longer.
    out
        Potential in uT m, shape (n,).
    """
    for c in range(len(z)):
        total = 0.0
        for k in range(len(flats)):
            dz = z[c] - heights[k]
            s = flats[k] + dz * dz
            # A root of 32 bits and two of Newton's steps: as exact as one of 64, in half the time.
            inverse = np.float64(np.float32(1) / np.sqrt(np.float32(s)))
            inverse *= 1.5 - 0.5 * s * inverse * inverse
            inverse *= 1.5 - 0.5 * s * inverse * inverse
            total += (levels[k] + uprights[k] * dz) * (inverse * inverse * inverse)
        out[c] -= total


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_near(
    points: FloatArray,
    corner: FloatArray,
    shape: tuple[int, int, int],
    starts: IntArray,
    table: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the near part of the sources at points (N, 3)."""
    px, py, pz, ux, uy, uz, edges, per_edges = table
    for n in range(len(points)):
        i, j = (points[n, 0] - corner[0]) / CELL, (points[n, 1] - corner[1]) / CELL
        k = (points[n, 2] - corner[2]) / CELL
        if not (0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]):
            continue
        cell = (int(i) * shape[1] + int(j)) * shape[2] + int(k)
        bx = by = bz = xx = yy = zz = xy = xz = yz = 0.0
        for e in range(starts[cell], starts[cell + 1]):
            x, y, z = points[n, 0] - px[e], points[n, 1] - py[e], points[n, 2] - pz[e]
            # At the edge all that follows vanishes to rounding, so that no branch is needed.
            edge, per_edge = edges[e], per_edges[e]
            s = min(x * x + y * y + z * z, edge)
            # S and its derivatives by s over the powers of the edge, by Horner's rule.
            t = s * per_edge - 1
            value, slope, half_curvature = TAYLOR[ORDER], 0.0, 0.0
            for p in range(ORDER - 1, -1, -1):
                half_curvature = half_curvature * t + slope
                slope = slope * t + value
                value = value * t + TAYLOR[p]
            inverse = 1 / s
            cube = inverse * np.sqrt(inverse)
            scale = per_edge * np.sqrt(per_edge)
            q0 = cube - scale * value
            q1 = -1.5 * cube * inverse - scale * per_edge * slope
            q2 = 3.75 * cube * inverse * inverse - scale * per_edge * per_edge * 2 * half_curvature
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
        add_symmetric(n, bx, by, bz, xx, yy, zz, xy, xz, yz, field, gradient)
