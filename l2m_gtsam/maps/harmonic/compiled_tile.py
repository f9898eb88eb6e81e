"""A tile made fast: its smooth part on a grid, its near sources one by one.

Where no grid covers a place, the exact field is summed term by term. All dipoles of a tile are one
sum, in place of one for each structure: with a few points in each of many tiles, calls would take
ten times as long as the sums.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from l2m_gtsam.data import FieldAndGradient, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.dipoles import Dipoles, add_dipoles
from l2m_gtsam.maps.harmonic.family import Family
from l2m_gtsam.maps.harmonic.frame import TileFrame, clip_rows, write_local
from l2m_gtsam.maps.harmonic.modes import Modes
from l2m_gtsam.maps.harmonic.near_sources import NearSources, PointSources, near_sources
from l2m_gtsam.maps.harmonic.places import Places
from l2m_gtsam.maps.harmonic.potential_grid import PotentialGrid, PotentialLattice, potential_grid
from l2m_gtsam.maps.harmonic.tile_shares import Blend
from l2m_gtsam.maps.harmonic.tiles import Tile
from l2m_gtsam.maps.harmonic.tiling import WAVE_NUMBERS

FIELD_TOLERANCE = 0.005  # uT
GRADIENT_TOLERANCE = 0.02  # uT/m
SAFETY = 0.5  # of the tolerance: places that were not checked may be somewhat worse
WAVE = 1.0  # spacing times the largest wave number: waves that short are never strong
# The gradient of sources' smooth parts errs by this times moment, spacing^6 and radius^-10.
SOURCE = 3e4
WIDEST = 0.75  # metres: within a larger radius too many sources are summed one by one
CHECKS = 300  # places, and as many beside sources
ATTEMPTS = 4


@dataclass(frozen=True)
class TermSum:
    """All terms of a tile, in its own frame.

    Attributes
    ----------
    sources
        All dipoles, tile frame, metres and uT m^3.
    others
        All other families with their weights.
    """

    sources: PointSources
    others: tuple[tuple[Family, FloatArray], ...]

    @classmethod
    def of(cls, tile: Tile) -> "TermSum":
        """Return the terms of a tile with the mean of its weights, and all of its dipoles."""
        families = zip(tile.basis.families, tile.basis.columns, strict=True)
        others = ((f, tile.weights.mean[at]) for f, at in families if not isinstance(f, Dipoles))
        return cls(sources_of(tile), tuple(others))

    def field_and_gradient(self, local: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m in the tile's frame."""
        field, gradient = np.zeros((len(local), 3)), np.zeros((len(local), 3, 3))
        for family, weights in self.others:
            part_field, part_gradient = family.field_and_gradient(local, weights)
            field += part_field
            gradient += part_gradient
        add_dipoles(local, self.sources.positions, self.sources.moments, field, gradient)
        return field, gradient


@runtime_checkable
class Smooth(Protocol):
    """A family whose potential a grid can hold."""

    def potential_on(
        self, x: FloatArray, y: FloatArray, z: FloatArray, weights: FloatArray
    ) -> FloatArray:
        """Return the potential in uT m at the nodes of these axes, shape (nx, ny, nz)."""


@dataclass(frozen=True)
class CompiledTile:
    """A tile's field from a grid and near sources.

    Attributes
    ----------
    frame
        The tile's box in the map frame.
    walls
        Lowest and highest coordinates of evaluation in the tile's frame, metres, shape (3,).
    grid
        The smooth part of the potential in the tile's frame.
    near
        Near parts of the sources that the grid leaves out, tile frame, uT m^3.
    exact
        Gives all terms of the exact tile. They answer where the grid does not reach; most tiles are
        never asked there, and their posterior stays on the disk.
    """

    frame: TileFrame
    walls: tuple[FloatArray, FloatArray]
    grid: PotentialGrid
    near: NearSources
    exact: Callable[[], TermSum]

    @cached_property  # added up over all tiles whenever one is made
    def nbytes(self) -> int:
        """Memory of grid and near sources in bytes; the terms are far less."""
        return self.grid.coefficients.nbytes + self.near.nbytes

    @cached_property
    def terms(self) -> TermSum:
        """All terms of the exact tile."""
        return self.exact()

    def field_and_gradient(self, points: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m in the map frame."""
        blend = Blend.of(len(points))
        self.add_to(blend, points, np.arange(len(points)), np.ones(len(points)))
        return blend.field, blend.gradient

    def add_to(self, blend: Blend, points: FloatArray, rows: IntArray, share: FloatArray) -> None:
        """Add what the tile predicts, times its share, to the sums over the others.

        Parameters
        ----------
        blend
            Sums of field (uT) and gradient (uT/m) over all N points; added to.
        points
            In the map frame in metres, shape (N, 3).
        rows, share
            Indices of the tile's points and its share in each, shape (K,).
        """
        # No kernel over all of it: a fast one that another calls may round otherwise when just
        # compiled than when read from the cache.
        frame, local = self.frame, np.empty((len(rows), 3))
        write_inside(points, rows, frame.corner, frame.R_map_tile, *self.walls, local)
        field, gradient = self.grid.field_and_gradient(local)
        self.near.add_to(local, field, gradient)
        missing = np.empty(len(rows), dtype=np.int64)
        R = frame.R_map_tile
        count = add_turned(rows, share, R, field, gradient, blend.field, blend.gradient, missing)
        if count:
            left = missing[:count]
            values = in_map(frame, *self.terms.field_and_gradient(local[left]))
            blend.add(rows[left], share[left], values)


def in_map(frame: TileFrame, field: FloatArray, gradient: FloatArray) -> FieldAndGradient:
    """Return field (N, 3) and gradient (N, 3, 3) of a tile's frame in the map frame."""
    R = frame.R_map_tile
    if np.array_equal(R, np.eye(3)):
        return field, gradient
    return field @ R.T, turned(gradient, R)


def turned(gradient: FloatArray, R: FloatArray) -> FloatArray:
    """Return ``R G R^T`` for symmetric matrices, shape (N, 3, 3)."""
    half = (gradient.reshape(-1, 3) @ R.T).reshape(-1, 3, 3)
    return np.asarray((half.transpose(0, 2, 1).reshape(-1, 3) @ R.T).reshape(-1, 3, 3))


@dataclass(frozen=True)
class Fineness:
    """How fine a tile is compiled.

    Attributes
    ----------
    spacing
        Distance of the grid's nodes in metres.
    radius
        Within which sources are summed one by one, in metres.
    """

    spacing: float
    radius: float

    def refined(self, excess: float) -> "Fineness":
        """Return what divides the error of sources by a factor and that of waves by its root."""
        return Fineness(self.spacing * excess ** (-1 / 12), self.radius * excess ** (1 / 20))


def compile_tile(tile: Tile, places: Places) -> CompiledTile | Tile:
    """Return a tile with a grid that is as fine as the tolerance asks, or the tile itself.

    How fine follows from waves and sources, then from the error at places drawn at random and
    beside sources. If no grid of a sensible size is good enough the exact tile remains.
    """
    terms = TermSum.of(tile)
    checks = check_places(tile, terms.sources, places)
    if not len(checks):
        return tile
    fineness = fineness_for(tile, terms.sources)
    frame = tile.basis.frame
    truth = in_map(frame, *terms.field_and_gradient(tile.clipped(frame.localise(checks))))
    for _ in range(ATTEMPTS):
        try:
            compiled = with_grid(tile, terms, places, fineness)
        except MapError:  # the grid would be too large
            return tile
        excess = worst(compiled.field_and_gradient(checks), truth)
        if excess <= 1:
            return compiled
        fineness = fineness.refined(1.5 * excess)
    return tile


def fineness_for(tile: Tile, sources: PointSources) -> Fineness:
    """Return the fineness that the physics suggests."""
    waves = [np.abs(f.kz).max() for f in tile.basis.families if isinstance(f, Modes)]
    spacing = WAVE / max(waves, default=WAVE_NUMBERS[0])
    strongest = np.linalg.norm(sources.moments, axis=1).max(initial=0.0)
    if strongest == 0:
        return Fineness(spacing, 0.0)
    strength = SOURCE * strongest / (SAFETY * GRADIENT_TOLERANCE)
    spacing = min(spacing, (WIDEST**10 / strength) ** (1 / 6))
    return Fineness(spacing, (strength * spacing**6) ** (1 / 10))


def worst(found: tuple[FloatArray, FloatArray], truth: tuple[FloatArray, FloatArray]) -> float:
    """Return the largest error over what is allowed of it."""
    field = float(np.abs(found[0] - truth[0]).max()) / FIELD_TOLERANCE
    gradient = float(np.abs(found[1] - truth[1]).max()) / GRADIENT_TOLERANCE
    return max(field, gradient) / SAFETY


def sources_of(tile: Tile) -> PointSources:
    """Return all dipoles of a tile in its own frame."""
    positions, moments = [np.empty((0, 3))], [np.empty((0, 3))]
    for family, columns in zip(tile.basis.families, tile.basis.columns, strict=True):
        if isinstance(family, Dipoles):
            positions.append(family.positions)
            moments.append(family.moments(tile.weights.mean[columns]))
    return PointSources(np.concatenate(positions), np.concatenate(moments))


def check_places(tile: Tile, sources: PointSources, places: Places) -> FloatArray:
    """Return places to compare at in the map frame: random ones and those next to sources."""
    random = places.random(20 * CHECKS)
    if not len(sources):
        return random[:CHECKS]
    away, _ = cKDTree(sources.positions).query(tile.basis.frame.localise(random))
    nearest = np.argsort(away)[:CHECKS]
    return np.concatenate([random[:CHECKS], random[nearest]])


def with_grid(tile: Tile, terms: TermSum, places: Places, fineness: Fineness) -> CompiledTile:
    """Return the tile with a grid of this fineness."""
    frame, spacing, radius = tile.basis.frame, fineness.spacing, fineness.radius
    sources = terms.sources

    def potential(lattice: PotentialLattice) -> FloatArray:
        phi = sources.smooth_potential(lattice, radius)
        for family, columns in zip(tile.basis.families, tile.basis.columns, strict=True):
            if isinstance(family, Smooth):
                phi += family.potential_on(*lattice.axes, tile.weights.mean[columns])
        return phi

    readings = frame.localise(places.readings)
    grid = potential_grid(potential, readings, places.reach, spacing, places.box(frame))
    upper = grid.lower + spacing * np.array(grid.coefficients.shape)
    near = near_sources(sources, grid.lower, upper, radius)
    return CompiledTile(frame, tile.walls, grid, near, lambda: terms)


@njit(cache=True, nogil=True)
def write_inside(
    points: FloatArray,
    rows: IntArray,
    corner: FloatArray,
    R_map_tile: FloatArray,
    low: FloatArray,
    high: FloatArray,
    local: FloatArray,
) -> None:
    """Write some points of the map frame in a tile's frame, moved within its walls.

    Parameters
    ----------
    points, rows
        In metres, shape (N, 3), and which of them, shape (K,).
    corner, R_map_tile
        See ``TileFrame``.
    low, high
        The walls in the tile's frame in metres, shape (3,).
    local
        What is written, metres, shape (K, 3).
    """
    for k in range(len(rows)):
        for i in range(3):
            local[k, i] = points[rows[k], i]
    write_local(local, corner, R_map_tile, local)
    clip_rows(local, low, high, local)


@njit(cache=True, nogil=True)
def add_turned(
    rows: IntArray,
    share: FloatArray,
    R_map_tile: FloatArray,
    part_field: FloatArray,
    part_gradient: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
    missing: IntArray,
) -> int:
    """Add what a tile predicts in its own frame, times its share, in the map frame.

    Parameters
    ----------
    rows, share
        Points that are added to, shape (K,), and the tile's share in each, shape (K,).
    R_map_tile
        Axes of the tile, shape (3, 3).
    part_field, part_gradient
        In the tile's frame in uT and uT/m, shapes (K, 3) and (K, 3, 3); NaN where not known.
    field, gradient
        In the map frame, shapes (N, 3) and (N, 3, 3); are added to.
    missing
        Which of ``rows`` are not known, shape (K,); nothing is added there.

    Returns
    -------
    int
        Number of rows that are not known.
    """
    R, B, G = R_map_tile, part_field, part_gradient
    half, count = np.empty((3, 3)), 0
    for k in range(len(rows)):
        if np.isnan(B[k, 0]):
            missing[count] = k
            count += 1
            continue
        n, weight = rows[k], share[k]
        for i in range(3):
            field[n, i] += weight * (R[i, 0] * B[k, 0] + R[i, 1] * B[k, 1] + R[i, 2] * B[k, 2])
            for j in range(3):
                half[i, j] = R[i, 0] * G[k, 0, j] + R[i, 1] * G[k, 1, j] + R[i, 2] * G[k, 2, j]
        for i in range(3):
            for j in range(3):
                both = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]
                gradient[n, i, j] += weight * both
    return count
