"""The tiles of a harmonic map for solvers: the same field, hundreds of times faster."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.compiled_tile import CompiledTile, TermSum, compile_tile
from l2m_gtsam.maps.harmonic.entries import compiled_entry, finite, floats, integers
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.near_sources import NearSources
from l2m_gtsam.maps.harmonic.places import AlongX, Places
from l2m_gtsam.maps.harmonic.potential_grid import PotentialGrid
from l2m_gtsam.maps.harmonic.tile_shares import Blend
from l2m_gtsam.maps.harmonic.tiles import Tile, Tiles
from l2m_gtsam.maps.tile_store import Arrays, Entry
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.progress import Count

MEMORY = 1_000_000_000  # bytes of grids that are kept
AT_ONCE = 4_096  # points that a tile is evaluated at: its answers stay in the processor's cache


@dataclass(frozen=True)
class CompiledTiles:
    """The tiles of a map, compiled when first needed; those used last are kept.

    Attributes
    ----------
    learnt, options, tiles
        Of the map whose tiles are compiled; see ``HarmonicMap``.
    made
        Compiled tiles by index, the one used last at the end.
    locks
        One for each tile, so that no tile is made twice, and one for ``made`` at the end.
    """

    learnt: Learnt
    options: HarmonicOptions
    tiles: Tiles
    made: OrderedDict[int, CompiledTile | Tile] = field(default_factory=OrderedDict)
    locks: tuple[Lock, ...] = ()

    @classmethod
    def of(cls, learnt: Learnt, options: HarmonicOptions, tiles: Tiles) -> "CompiledTiles":
        """Return the tiles of a map, none of them made yet."""
        return cls(learnt, options, tiles, locks=tuple(Lock() for _ in range(len(tiles) + 1)))

    def __reduce__(self) -> tuple[Any, ...]:
        return CompiledTiles.of, (self.learnt, self.options, self.tiles)

    def tile(self, index: int) -> CompiledTile | Tile:
        """Return a tile, compiled; the exact one where no grid is good enough."""
        with self.locks[index]:
            found = self.made.get(index)
            if found is None:
                found = self.compiled(index, partial(self.tiles.__getitem__, index))
                with self.locks[-1]:
                    self.made[index] = found
                    self._forget()
            with self.locks[-1]:
                if index in self.made:
                    self.made.move_to_end(index)
        return found

    def compiled(self, index: int, solved: Callable[[], Tile]) -> CompiledTile | Tile:
        """Return a tile as it was kept, else compiled and kept, without holding it in memory.

        Parameters
        ----------
        index
            Of the tile.
        solved
            Gives its exact form, which is asked for only where it is needed.
        """
        store, places = self.tiles.store, self.places(index)
        entry, frame = self.entry(index, places), self.learnt.frame(index)
        found = store.recall(entry, partial(compiled_from_arrays, frame, solved))
        if found is None:
            found = compile_tile(solved(), places)
            store.keep(entry, compiled_to_arrays(found))
        return found

    @cached_property
    def readings(self) -> AlongX:
        """Where the map was surveyed."""
        return AlongX.of(self.learnt.readings.points)

    def entry(self, index: int, places: Places) -> Entry:
        """Return what a compiled tile is kept as."""
        return compiled_entry(self.learnt, index, self.tiles.entry(index), places)

    def places(self, index: int) -> Places:
        """Return where a tile is evaluated."""
        tiling = self.learnt.tiling
        return Places.around(
            self.readings,
            self.options.reach,
            tiling.grid.centres[index],
            0.5 * tiling.grid.size + tiling.blend,
        )

    def make_all(self, progress: Count) -> int:
        """Have all tiles of a map in its store, solved and compiled, and nothing else.

        A store that is full ends it: the other tiles are made when they are needed. None is held
        in memory.

        Parameters
        ----------
        progress
            Called with the number of tiles that are done and that of all.

        Returns
        -------
        int
            How many tiles the store has.
        """
        indices, lock, done = range(len(self.tiles)), Lock(), 0
        solved = [self.tiles.entry(index) for index in indices]
        compiled = [self.entry(index, self.places(index)) for index in indices]
        self.tiles.store.sweep([*solved, *compiled])

        def make(index: int) -> bool:
            nonlocal done
            if not self.tiles.store.takes_more:
                return False
            tile = self.tiles.made(index)
            self.compiled(index, lambda: tile)
            with lock:
                done += 1
                progress(done, len(indices))
            return self.tiles.store.takes_more

        return sum(in_threads(make, indices))

    def blended(self, points: FloatArray) -> FieldAndGradient:
        """Return the blended prediction of the tiles at points."""
        blend = Blend.of(len(points))
        for part in self.learnt.tiling.by_tile(points):
            tile = self.tile(part.tile)
            for start in range(0, len(part.rows), AT_ONCE):
                at = slice(start, start + AT_ONCE)
                rows, share = part.rows[at], part.share[at]
                if isinstance(tile, CompiledTile):
                    tile.add_to(blend, points, rows, share)
                else:
                    blend.add(rows, share, tile.field_and_gradient(points[rows]))
        return blend.field, blend.gradient

    def _forget(self) -> None:
        held = sum(tile.nbytes for tile in self.made.values() if isinstance(tile, CompiledTile))
        while held > MEMORY and len(self.made) > 1:
            _, oldest = self.made.popitem(last=False)
            held -= oldest.nbytes if isinstance(oldest, CompiledTile) else 0


def compiled_to_arrays(compiled: CompiledTile | Tile) -> Arrays:
    """Return a compiled tile as arrays; none for a tile that no grid is good enough for."""
    if isinstance(compiled, Tile):
        return {}
    grid, near = compiled.grid, compiled.near
    return {
        "walls": np.stack(compiled.walls),
        "lower": grid.lower,
        "spacing": np.array([grid.spacing]),
        "coefficients": grid.coefficients,
        "corner": near.corner,
        "shape": np.array(near.shape),
        "starts": near.starts,
        "table": near.table,
    }


def compiled_from_arrays(
    frame: TileFrame, solved: Callable[[], Tile], arrays: Arrays
) -> CompiledTile | Tile:
    """Return what ``compiled_to_arrays`` took apart.

    Parameters
    ----------
    frame, solved
        Of the solved tile that it belongs to: its box, and what gives the whole.
    arrays
        Of the compiled tile.

    Raises
    ------
    MapError
        If an array is missing, of the wrong shape, or makes no sense.
    """
    if not arrays:
        return solved()
    low, high = finite(arrays, "walls", (2, 3))
    grid, near = grid_from_arrays(arrays), near_from_arrays(arrays)
    return CompiledTile(frame, (low, high), grid, near, lambda: TermSum.of(solved()))


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
