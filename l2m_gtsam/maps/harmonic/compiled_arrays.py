"""A compiled tile as plain arrays, and back with checks."""

import numpy as np

from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.compiled_tile import CompiledTile, sources_of
from l2m_gtsam.maps.harmonic.kept_arrays import finite, floats, integers
from l2m_gtsam.maps.harmonic.near_sources import NearSources
from l2m_gtsam.maps.harmonic.potential_grid import PotentialGrid
from l2m_gtsam.maps.harmonic.term_sum import TermSum
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.tile_store import Arrays


def compiled_to_arrays(compiled: CompiledTile | Tile) -> Arrays:
    """Return a compiled tile as arrays; none for a tile that no grid is good enough for."""
    if isinstance(compiled, Tile):
        return {}
    grid, near = compiled.grid, compiled.near
    return {
        "lower": grid.lower,
        "spacing": np.array([grid.spacing]),
        "coefficients": grid.coefficients,
        "corner": near.corner,
        "shape": np.array(near.shape),
        "starts": near.starts,
        "table": near.table,
    }


def compiled_from_arrays(tile: Tile, arrays: Arrays) -> CompiledTile | Tile:
    """Return what ``compiled_to_arrays`` took apart, with the solved tile that it belongs to.

    Raises
    ------
    MapError
        If an array is missing, of the wrong shape, or makes no sense.
    """
    if not arrays:
        return tile
    grid, near = grid_from_arrays(arrays), near_from_arrays(arrays)
    return CompiledTile(tile, grid, near, TermSum.of(tile, sources_of(tile)))


def grid_from_arrays(arrays: Arrays) -> PotentialGrid:
    """Return the grid of a compiled tile."""
    spacing = float(finite(arrays, "spacing", (1,))[0])
    coefficients = floats(arrays, "coefficients", (None, None, None))  # NaN where not known
    if spacing <= 0 or np.isinf(coefficients).any():
        raise MapError("the grid has a spacing or coefficients that cannot be")
    return PotentialGrid(finite(arrays, "lower", (3,)), spacing, coefficients)


def near_from_arrays(arrays: Arrays) -> NearSources:
    """Return the near sources of a compiled tile: no list may lead out of the table."""
    nx, ny, nz = (int(count) for count in integers(arrays, "shape", (3,)))
    table = finite(arrays, "table", (8, None))
    if min(nx, ny, nz) < 0:
        raise MapError("the cells of near sources are fewer than none")
    starts = integers(arrays, "starts", (nx * ny * nz + 1,))
    if starts[0] != 0 or starts[-1] != table.shape[1] or (np.diff(starts) < 0).any():
        raise MapError("the lists of near sources do not fit their table")
    return NearSources(finite(arrays, "corner", (3,)), (nx, ny, nz), starts, table)
