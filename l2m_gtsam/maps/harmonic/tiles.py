"""The tiles of a map, solved when they are first needed."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import partial
from threading import Lock

from l2m_gtsam.maps.harmonic.entries import solved_entry
from l2m_gtsam.maps.harmonic.evidence import condition, normal_of
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.local import local_hyperparameters
from l2m_gtsam.maps.harmonic.solved_arrays import solved_from_arrays, solved_to_arrays
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.tile_store import NO_STORE, TileStore
from l2m_gtsam.parallel.threads import in_threads

MEMORY = 2_000_000_000  # bytes of the tiles' covariances that are kept


class Tiles:
    """Tiles by index; those used last are kept as long as memory lasts.

    A drive crosses few tiles of a large map: solving them all would cost more than the
    calibration.

    Parameters
    ----------
    learnt
        Readings, prior, sources and tiling of the map.
    kept
        Tiles solved already, by index.
    store
        Keeps tiles from run to run.
    """

    def __init__(
        self,
        learnt: Learnt,
        kept: Mapping[int, Tile] | None = None,
        store: TileStore = NO_STORE,
    ) -> None:
        self.store = store
        self._learnt = learnt
        self._solved: OrderedDict[int, Tile] = OrderedDict(kept or {})
        self._held = sum(tile.nbytes for tile in self._solved.values())
        self._lock = Lock()

    def __reduce__(self) -> tuple[type["Tiles"], tuple[Learnt, None, TileStore]]:
        # Another process solves the tiles that it needs: they are ten times as large.
        return Tiles, (self._learnt, None, self.store)

    def __len__(self) -> int:
        return len(self._learnt.tiling)

    def __getitem__(self, index: int) -> Tile:
        if not 0 <= index < len(self):
            raise IndexError(index)
        with self._lock:
            found = self._solved.get(index)
            if found is not None:
                self._solved.move_to_end(index)
                return found
        # Outside of the lock: two threads solve different tiles at the same time.
        found = self.made(index)
        with self._lock:
            self._remember(index, found)
        return found

    def __iter__(self) -> Iterator[Tile]:
        return (self[index] for index in range(len(self)))

    def made(self, index: int) -> Tile:
        """Return a tile as it was kept, else solved and kept, without holding it in memory."""
        entry = solved_entry(self._learnt, index)
        found = self.store.recall(entry, partial(solved_from_arrays, self._learnt, index))
        if found is None:
            found = solved_tile(self._learnt, index)
            self.store.keep(entry, solved_to_arrays(found))
        return found

    def solve_all(self) -> None:
        """Solve every tile now."""
        in_threads(self.__getitem__, range(len(self)))

    @property
    def solved(self) -> dict[int, Tile]:
        """Return the tiles that are in memory."""
        with self._lock:
            return dict(self._solved)

    def _remember(self, index: int, tile: Tile) -> None:
        if index not in self._solved:  # another thread may have been faster
            self._held += tile.nbytes
        self._solved[index] = tile
        self._solved.move_to_end(index)
        while self._held > MEMORY and len(self._solved) > 1:
            _, oldest = self._solved.popitem(last=False)
            self._held -= oldest.nbytes


def solved_tile(learnt: Learnt, index: int) -> Tile:
    """Return a tile with the posterior of its weights."""
    rows = learnt.members[index]
    basis = learnt.basis(index, rows)
    normal = normal_of(basis, learnt.readings[rows])
    own = local_hyperparameters(basis, normal, learnt.hyperparameters, learnt.local)
    weights = condition(normal, basis.prior(own).log_variance, own.noise)
    return Tile(basis, weights, own, learnt.resolution)
