"""The tiles of a map beside its file: read from there, made there, and kept."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.tile_store import TileStore
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.storage.tile_folder import tiles_beside


@runtime_checkable
class Tiled(Protocol):
    """A map whose tiles are worth keeping."""

    def with_store(self, store: TileStore) -> "FieldMap":
        """Return the map that keeps its tiles in a store."""
        ...

    def make_tiles(self, told: Callable[[int, int], None]) -> int:
        """Have all tiles in the store, and return how many there are."""
        ...


def with_tiles(field_map: FieldMap, path: Path) -> FieldMap:
    """Return a map that keeps its tiles, if it has any, beside its file."""
    return field_map.with_store(tiles_beside(path)) if isinstance(field_map, Tiled) else field_map


def make_tiles(field_map: FieldMap, path: Path, progress: Progress) -> None:
    """Make all tiles of a map, if it has any, and keep them beside its file.

    Parameters
    ----------
    field_map, path
        The map and its file.
    progress
        Called with a stage and the fraction of it that is done.
    """
    kept = with_tiles(field_map, path)
    if isinstance(kept, Tiled):
        kept.make_tiles(counter("making tiles", progress))
