"""A magnetic potential on a regular grid: field and gradient for solvers that ask a lot.

Field and gradient are the exact derivatives of one scalar, a spline without steps, which makes the
gradient symmetric; see ``spline``. A node has an effect no further than 8 cells away.

The error of the field falls with the seventh power of the spacing and that of its gradient with
the sixth. Where the field varies by 30 uT, 0.005 uT and 0.02 uT/m are met with a spacing of 0.09 of
the distance to a dipole, or of 0.7 / k for a wave of number k.

A grid lives in the frame in which it was made; here that of its tile.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import BoolArray, FieldAndGradient, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.spline import (
    BELOW,
    HALF_TAPS,
    WIDTH,
    spline_coefficients,
    spline_derivatives,
)
from l2m_gtsam.maps.training import checked_points

MOST_NODES = 8_000_000  # 64 MB of coefficients, and four times as much while they are computed
AROUND = WIDTH - 1 + 2 * HALF_TAPS  # nodes per axis that a cell needs beside its own
EDGE = 1e-6  # cells: more than the rounding of a place that is just within reach


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
