"""The harmonic map for solvers: the same field, hundreds of times faster."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import Protocol

import numpy as np

from l2m_gtsam.data import FieldSample, FloatArray, IntArray, MapState
from l2m_gtsam.maps.field_map import MapSummary
from l2m_gtsam.maps.harmonic.blend import Blend
from l2m_gtsam.maps.harmonic.compiled_arrays import compiled_from_arrays, compiled_to_arrays
from l2m_gtsam.maps.harmonic.compiled_tile import CompiledTile, compile_tile
from l2m_gtsam.maps.harmonic.entries import compiled_entry
from l2m_gtsam.maps.harmonic.error_modes import ErrorModes
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.places import Places
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.training import TrainingSet, checked_points
from l2m_gtsam.parallel.threads import in_threads

MEMORY = 1_000_000_000  # bytes of grids that are kept
SHARES = 4  # that points are divided into, for as many threads at most
PIECE = 65_536  # about the most points of a share
AT_ONCE = 4_096  # points that a tile is evaluated at: its answers stay in the processor's cache
BLOCK = 0.5  # metres: what a map knows of a square of this size fits the processor's cache
SERIAL = 6_000  # fewer points than this are not worth threads


class ExactMap(Protocol):
    """What the compiled form needs of the map itself; see ``HarmonicMap``."""

    @property
    def learnt(self) -> Learnt:
        """Readings, prior, sources and tiling."""
        ...

    @property
    def options(self) -> HarmonicOptions:
        """Effective options."""
        ...

    @property
    def tiles(self) -> Tiles:
        """One for each cell of the tiling."""
        ...

    @property
    def kind(self) -> str:
        """Name of the map kind."""
        ...

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""
        ...

    def sample(
        self,
        points: FloatArray,
        answers: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]],
    ) -> FieldSample:
        """Return what is known at points, given who answers for those near a reading."""
        ...

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis, also outside."""
        ...

    def errors_over(self, points: FloatArray, /) -> ErrorModes:
        """Return the map's error over places as correlated numbers."""
        ...

    def updated(self, points: FloatArray, field: FloatArray) -> "ExactMap":
        """Return the map with more readings."""
        ...

    def to_state(self) -> MapState:
        """Return the map as plain arrays and facts."""
        ...


@dataclass(frozen=True)
class CompiledTiles:
    """The tiles of a map, compiled when first needed; those used last are kept.

    Attributes
    ----------
    exact
        Map whose tiles are compiled.
    made
        Compiled tiles by index, the one used last at the end.
    locks
        One for each tile, so that no tile is made twice, and one for ``made`` at the end.
    """

    exact: ExactMap
    made: OrderedDict[int, CompiledTile | Tile] = field(default_factory=OrderedDict)
    locks: tuple[Lock, ...] = ()

    @classmethod
    def of(cls, exact: ExactMap) -> "CompiledTiles":
        """Return the tiles of a map, none of them made yet."""
        return cls(exact, locks=tuple(Lock() for _ in range(len(exact.tiles) + 1)))

    def __reduce__(self) -> tuple[Callable[[ExactMap], "CompiledTiles"], tuple[ExactMap]]:
        return CompiledTiles.of, (self.exact,)

    def tile(self, index: int) -> CompiledTile | Tile:
        """Return a tile, compiled; the exact one where no grid is good enough."""
        with self.locks[index]:
            found = self.made.get(index)
            if found is None:
                found = self.compiled(index, self.exact.tiles[index])
                with self.locks[-1]:
                    self.made[index] = found
                    self._forget()
            with self.locks[-1]:
                if index in self.made:
                    self.made.move_to_end(index)
        return found

    def compiled(self, index: int, tile: Tile) -> CompiledTile | Tile:
        """Return a tile as it was kept, else compiled and kept, without holding it in memory."""
        store, places = self.exact.tiles.store, self.places(index)
        entry = compiled_entry(self.exact.learnt, index, places)
        found = store.recall(entry, partial(compiled_from_arrays, tile))
        if found is None:
            found = compile_tile(tile, places)
            store.keep(entry, compiled_to_arrays(found))
        return found

    def places(self, index: int) -> Places:
        """Return where a tile is evaluated."""
        tiling = self.exact.learnt.tiling
        return Places.around(
            self.exact.learnt.readings.points,
            self.exact.options.reach,
            tiling.grid.centres[index],
            0.5 * tiling.grid.size + tiling.blend,
        )

    def _forget(self) -> None:
        held = sum(tile.nbytes for tile in self.made.values() if isinstance(tile, CompiledTile))
        while held > MEMORY and len(self.made) > 1:
            _, oldest = self.made.popitem(last=False)
            held -= oldest.nbytes if isinstance(oldest, CompiledTile) else 0


@dataclass(frozen=True)
class CompiledMap:
    """A harmonic map whose field and gradient come from grids, within 5 nT and 20 nT/m.

    That holds wherever the exact map is near readings; elsewhere the exact map answers.
    Everything but field and gradient is that of the exact map.

    Attributes
    ----------
    exact
        Map that it approximates, which answers far from readings.
    tiles
        Tiles of that map, compiled on first use.
    """

    exact: ExactMap
    tiles: CompiledTiles

    @classmethod
    def of(cls, exact: ExactMap) -> "CompiledMap":
        """Return the compiled form of a map; tiles are compiled when they are first needed."""
        return cls(exact, CompiledTiles.of(exact))

    @property
    def kind(self) -> str:
        """Name of the map kind."""
        return self.exact.kind

    @property
    def readings(self) -> TrainingSet:
        """Readings in the map frame, merged."""
        return self.exact.learnt.readings

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""
        return self.exact.summary

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance; see ``FieldMap``."""
        return self.exact.sample(
            points, lambda near: (*self.field_and_gradient(near), self.variance(near))
        )

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient, also outside; see ``FieldMap``."""
        points = checked_points(points)
        if len(points) < SERIAL:
            return self._said(points)
        field, gradient = np.empty((len(points), 3)), np.empty((len(points), 3, 3))

        def answer(rows: IntArray) -> None:
            field[rows], gradient[rows] = self._said(points[rows])

        in_threads(answer, np.array_split(by_place(points), max(SHARES, len(points) // PIECE)))
        return field, gradient

    def _said(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the blended prediction of the tiles at points."""
        blend = Blend.of(len(points))
        for visit in self.exact.learnt.tiling.visits(points):
            tile = self.tiles.tile(visit.tile)
            for start in range(0, len(visit.rows), AT_ONCE):
                rows, share = visit.rows[start : start + AT_ONCE], visit.share[start:]
                if isinstance(tile, CompiledTile):
                    tile.add_to(blend, points, rows, share)
                else:
                    blend.add(rows, share, tile.field_and_gradient(points[rows]))
        return blend.field, blend.gradient

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis, also outside; see ``FieldMap``."""
        return self.exact.variance(points)

    def errors_over(self, points: FloatArray, /) -> ErrorModes:
        """Return the map's error over places, shape (N, 3) in metres, as correlated numbers."""
        return self.exact.errors_over(points)

    def updated(self, points: FloatArray, field: FloatArray, /) -> "CompiledMap":
        """Return the map with more readings; see ``FieldMap``."""
        return CompiledMap.of(self.exact.updated(points, field))

    def to_state(self) -> MapState:
        """Return the exact map as plain arrays and facts."""
        return self.exact.to_state()


def by_place(points: FloatArray) -> IntArray:
    """Return the indices of points, shape (N,), in an order that stays in one place at a time.

    Threads that are given parts of it meet few tiles in common.
    """
    across, along = (np.floor((at - at.min()) / BLOCK) for at in points[:, :2].T)
    # Numbers of 16 bits are sorted in linear time; where they run over, places take turns.
    numbers = (across * (along.max() + 1) + along) % 2**16
    return np.argsort(numbers.astype(np.uint16), kind="stable")
