"""A magnetic potential on a regular grid: field and gradient for solvers that ask a lot.

Field and gradient are the exact derivatives of one scalar, a spline without steps, which makes the
gradient symmetric. A node has an effect no further than 8 cells away.

The error of the field falls with the seventh power of the spacing and that of its gradient with
the sixth. Where the field varies by 30 uT, 0.005 uT and 0.02 uT/m are met with a spacing of 0.09 of
the distance to a dipole, or of 0.7 / k for a wave of number k.

A grid lives in the frame in which it was made; here that of its tile.

The spline is a B-spline of degree 7 on every axis: six times continuously differentiable, so that
not even second derivatives step from cell to cell. A spline that meets the values at the nodes
would need a solve over the whole grid, and a strong source beside it would ring everywhere. Here
the coefficients come from a short symmetric filter of the values instead (a quasi-interpolant,
after C. de Boor and G. J. Fix, "Spline approximation by quasiinterpolants", 1973): polynomials of
degree 7 are still reproduced, and a node has an effect no further than 8 cells away.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import comb, factorial

import numpy as np
from numba import njit
from scipy import ndimage

from l2m_gtsam.data import BoolArray, FieldAndGradient, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.triangular import FAST
from l2m_gtsam.maps.training import checked_points

DEGREE = 7
WIDTH = DEGREE + 1  # coefficients per axis that a point needs
BELOW = DEGREE // 2  # of them, those below the node at the lower side of the point's cell
HALF_TAPS = 4  # values to each side that a coefficient needs
MOST_NODES = 8_000_000  # 64 MB of coefficients, and four times as much while they are computed
AROUND = WIDTH - 1 + 2 * HALF_TAPS  # nodes per axis that a cell needs beside its own
EDGE = 1e-6  # cells: more than the rounding of a place that is just within reach


def spline_values() -> FloatArray:
    """Return the B-spline at its inner nodes, shape (DEGREE,)."""
    return np.asarray(spline_pieces()[0, :DEGREE])


def spline_pieces() -> FloatArray:
    """Return the polynomials of the spline, shape (WIDTH, WIDTH).

    ``pieces[p, k]`` is the factor of ``f**p`` in the weight of coefficient k of the stencil, for a
    point at the fraction f of its cell; from the truncated powers that sum to the B-spline.
    """
    pieces = np.zeros((WIDTH, WIDTH))
    for k in range(WIDTH):
        for j in range(WIDTH - k):
            for p in range(WIDTH):
                power = comb(DEGREE, p) * (DEGREE - k - j) ** (DEGREE - p)
                pieces[p, k] += (-1) ** j * comb(WIDTH, j) * power / factorial(DEGREE)
    return pieces


def filter_taps() -> FloatArray:
    """Return the filter that makes coefficients of values, shape (2 HALF_TAPS + 1,).

    Symmetric, and such that filter and spline together leave even powers up to 2 HALF_TAPS, and
    odd ones by symmetry, unchanged at the nodes.
    """
    spline, knots = spline_values(), np.arange(-BELOW, BELOW + 1)
    moments = np.empty((HALF_TAPS + 1, HALF_TAPS + 1))
    for tap in range(HALF_TAPS + 1):
        places = np.concatenate([knots + tap, knots - tap])
        weights = np.tile(spline, 2) / 2
        moments[:, tap] = [weights @ places ** (2.0 * row) for row in range(HALF_TAPS + 1)]
    one_side = np.linalg.solve(moments, np.eye(HALF_TAPS + 1)[0])
    one_side[1:] /= 2
    return np.concatenate([one_side[:0:-1], one_side])


def spline_coefficients(values: FloatArray) -> FloatArray:
    """Return the coefficients for node values, HALF_TAPS fewer on each side; consumes ``values``.

    A coefficient is NaN where one of its values is.
    """
    for axis in range(3):
        ndimage.correlate1d(values, TAPS, axis, values, mode="constant", cval=np.nan)
    inner = slice(HALF_TAPS, -HALF_TAPS)
    return np.ascontiguousarray(values[inner, inner, inner])


TAPS = filter_taps()
PIECES = np.tile(spline_pieces(), 3)  # once for each axis

# An index that cannot be negative need not be asked whether it counts from the end: loops over it
# run in vector registers.
UNSIGNED = np.uint64


# Not the mode of a fast kernel that calls it, which it has where it is compiled for that one.
@njit(cache=True, nogil=True, fastmath=False)
def stencil_start(
    point: FloatArray, lower: FloatArray, spacing: float, shape: tuple[int, int, int]
) -> tuple[int, int, int]:
    """Return the first coefficient of a point's stencil per axis, or -1, -1, -1 if not inside."""
    per_metre = 1 / spacing
    i = np.floor((point[0] - lower[0]) * per_metre) - BELOW
    j = np.floor((point[1] - lower[1]) * per_metre) - BELOW
    k = np.floor((point[2] - lower[2]) * per_metre) - BELOW
    within = 0 <= i <= shape[0] - WIDTH and 0 <= j <= shape[1] - WIDTH
    if within and 0 <= k <= shape[2] - WIDTH:
        return int(i), int(j), int(k)
    return -1, -1, -1


@njit(cache=True, nogil=True, fastmath=FAST)
def spline_weights(fraction: FloatArray, weights: FloatArray) -> None:
    """Write the weights of a stencil along x, y and z and two derivatives, shape (3, 3 WIDTH).

    ``fraction``, shape (3 WIDTH,), holds the position of a point within its cell: one loop over
    all axes runs in vector registers.
    """
    for k in range(3 * WIDTH):
        f = fraction[k]
        v, s, half_curvature = PIECES[DEGREE, k], 0.0, 0.0
        for p in range(DEGREE - 1, -1, -1):
            half_curvature = half_curvature * f + s
            s = s * f + v
            v = v * f + PIECES[p, k]
        weights[0, k], weights[1, k], weights[2, k] = v, s, 2 * half_curvature


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")  # calls would cost a tenth
def stencil_derivatives(
    flat: FloatArray,
    start: np.uint64,
    steps: tuple[np.uint64, np.uint64],
    weights: FloatArray,
    per_metre: float,
    per_area: float,
    first: FloatArray,
    second: FloatArray,
) -> None:
    """Write first derivatives (3,) and second ones (3, 3) at one point with these weights.

    Its stencil begins at ``start`` of the coefficients, shape (M,), and goes on by these steps
    along x and y. It is summed axis by axis, y first, for a row of coefficients along z at a time.
    """
    # Names count the derivatives that weights and sums hold.
    value, slope, curvature = weights[0], weights[1], weights[2]
    x0, y0, z0 = value[:WIDTH], value[WIDTH : 2 * WIDTH], value[2 * WIDTH :]
    x1, y1, z1 = slope[:WIDTH], slope[WIDTH : 2 * WIDTH], slope[2 * WIDTH :]
    x2, y2, z2 = curvature[:WIDTH], curvature[WIDTH : 2 * WIDTH], curvature[2 * WIDTH :]
    (step_x, step_y), width = steps, UNSIGNED(WIDTH)
    bx = by = bz = xx = yy = zz = xy = xz = yz = 0.0
    for a in range(width):
        s00 = s01 = s02 = s10 = s11 = s20 = 0.0
        row = start + a * step_x
        for c in range(width):
            t0 = t1 = t2 = 0.0
            for b in range(width):
                coefficient = flat[row + b * step_y + c]
                t0 += y0[b] * coefficient
                t1 += y1[b] * coefficient
                t2 += y2[b] * coefficient
            s00 += z0[c] * t0
            s01 += z1[c] * t0
            s02 += z2[c] * t0
            s10 += z0[c] * t1
            s11 += z1[c] * t1
            s20 += z0[c] * t2
        bx += x1[a] * s00
        by += x0[a] * s10
        bz += x0[a] * s01
        xx += x2[a] * s00
        yy += x0[a] * s20
        zz += x0[a] * s02
        xy += x1[a] * s10
        xz += x1[a] * s01
        yz += x0[a] * s11
    first[0], first[1], first[2] = bx * per_metre, by * per_metre, bz * per_metre
    second[0, 0], second[1, 1], second[2, 2] = xx * per_area, yy * per_area, zz * per_area
    second[0, 1] = second[1, 0] = xy * per_area
    second[0, 2] = second[2, 0] = xz * per_area
    second[1, 2] = second[2, 1] = yz * per_area


@njit(cache=True, nogil=True, fastmath=FAST)
def spline_derivatives(
    points: FloatArray,
    lower: FloatArray,
    spacing: float,
    coefficients: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write first derivatives (N, 3) and second ones (N, 3, 3) at points (N, 3), one by one.

    NaN where a coefficient is missing.
    """
    per_metre, per_area = 1 / spacing, 1 / (spacing * spacing)
    fraction, weights = np.empty(3 * WIDTH), np.empty((3, 3 * WIDTH))
    flat, step_y = coefficients.reshape(-1), UNSIGNED(coefficients.shape[2])
    step_x = UNSIGNED(coefficients.shape[1]) * step_y
    steps = (step_x, step_y)
    for n in range(len(points)):
        i, j, k = stencil_start(points[n], lower, spacing, coefficients.shape)
        if i < 0:
            for a in range(3):
                field[n, a] = np.nan
                for c in range(3):
                    gradient[n, a, c] = np.nan
            continue
        x = (points[n, 0] - lower[0]) * per_metre - i - BELOW
        y = (points[n, 1] - lower[1]) * per_metre - j - BELOW
        z = (points[n, 2] - lower[2]) * per_metre - k - BELOW
        for a in range(WIDTH):
            fraction[a], fraction[WIDTH + a], fraction[2 * WIDTH + a] = x, y, z
        spline_weights(fraction, weights)
        start = UNSIGNED(i) * step_x + UNSIGNED(j) * step_y + UNSIGNED(k)
        stencil_derivatives(flat, start, steps, weights, per_metre, per_area, field[n], gradient[n])


@dataclass(frozen=True)
class Box:
    """A box along the axes: corners in metres, shape (3,)."""

    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True)
class PotentialLattice:
    """Nodes of a regular grid.

    Attributes
    ----------
    lower
        Node (0, 0, 0) in metres, shape (3,).
    spacing
        Edge of a cell in metres.
    needed
        Nodes whose potential is asked for, shape (nx, ny, nz); what the others get is not used.
    """

    lower: FloatArray
    spacing: float
    needed: BoolArray

    @property
    def axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coordinates of the nodes along x, y and z in metres."""
        x, y, z = (
            start + self.spacing * np.arange(count)
            for start, count in zip(self.lower, self.needed.shape, strict=True)
        )
        return x, y, z


Potential = Callable[[PotentialLattice], FloatArray]


@dataclass(frozen=True)
class PotentialGrid:
    """A spline of a potential whose gradient is the field.

    Attributes
    ----------
    lower
        Place of coefficient (0, 0, 0) in metres, shape (3,).
    spacing
        Edge of a cell in metres.
    coefficients
        Of the spline in uT m, shape (nx, ny, nz); NaN where the potential is not known.
    """

    lower: FloatArray
    spacing: float
    coefficients: FloatArray

    def field_and_gradient(self, points: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m; NaN where not covered.

        ``gradient[n, i, j]`` = dB_i/dx_j, symmetric to the last digit. Scattered places wait for
        memory: sorted by where they are they are answered three times faster.

        Parameters
        ----------
        points
            Metres, shape (N, 3).
        """
        field, gradient = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        spline_derivatives(points, self.lower, self.spacing, self.coefficients, field, gradient)
        return field, gradient


def potential_grid(
    potential: Potential, points: FloatArray, reach: float, spacing: float, box: Box
) -> PotentialGrid:
    """Return the grid that covers every place of a box near a point.

    Parameters
    ----------
    potential
        Maps a lattice to the potential at its nodes in uT m, shape (nx, ny, nz). Places that need
        a node where it is not finite are not covered. Nodes lie up to 10 cells beyond the places.
    points
        Positions of the survey in metres, shape (K, 3).
    reach
        How far from a point, along every axis, places are covered, in metres.
    spacing
        Edge of a cell in metres.
    box
        Places beyond it need not be covered.

    Raises
    ------
    MapError
        If there are no points near the box, one is not finite, or there would be too many nodes.
    """
    points = checked_points(points)
    points = points[((points >= box.lower - reach) & (points <= box.upper + reach)).all(axis=1)]
    if not len(points):
        raise MapError("a potential grid without points: at least one is needed")
    slack = EDGE * spacing
    lower = np.maximum(points.min(axis=0) - reach, box.lower) - slack
    extent = np.minimum(points.max(axis=0) + reach, box.upper) + slack - lower
    shape = check_size(np.floor(extent / spacing) + 1 + AROUND, spacing)
    first = np.floor((points - lower - reach - slack) / spacing).astype(np.int64)
    last = np.floor((points - lower + reach + slack) / spacing).astype(np.int64)
    needed = spread(np.maximum(first, 0), np.minimum(last + AROUND, np.array(shape) - 1), shape)
    lattice = PotentialLattice(lower - (HALF_TAPS + BELOW) * spacing, spacing, needed)
    values = np.where(needed, potential(lattice), np.nan)
    values[~np.isfinite(values)] = np.nan
    coefficients = spline_coefficients(values)
    return PotentialGrid(lattice.lower + HALF_TAPS * spacing, spacing, coefficients)


def check_size(counts: FloatArray, spacing: float) -> tuple[int, int, int]:
    """Return node counts per axis, shape (3,), as integers, or refuse a grid that is too large."""
    nodes = float(np.prod(counts))
    if nodes > MOST_NODES:
        raise MapError(
            f"a potential grid of spacing {spacing:.3g} m would have {nodes / 1e6:,.0f} million "
            f"nodes, at most {MOST_NODES / 1e6:.0f} million are allowed: raise the spacing"
        )
    nx, ny, nz = (int(count) for count in counts)
    return nx, ny, nz


def spread(first: IntArray, last: IntArray, shape: tuple[int, int, int]) -> BoolArray:
    """Return the nodes of the boxes whose first and last nodes, shape (K, 3), are given."""
    counts = np.zeros([nodes + 1 for nodes in shape], dtype=np.int32)
    # Signs at the corners by inclusion and exclusion: running sums along the axes then count one
    # inside of a box and none outside (summed-area tables, Crow 1984).
    ends = np.stack([first, last + 1])
    for corner in np.ndindex(2, 2, 2):
        i, j, k = (ends[side, :, axis] for axis, side in enumerate(corner))
        np.add.at(counts, (i, j, k), (-1) ** sum(corner))
    for axis in range(3):
        np.cumsum(counts, axis=axis, dtype=np.int32, out=counts)
    return np.asarray(counts[:-1, :-1, :-1] > 0)
