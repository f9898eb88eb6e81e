"""The tiles of a map, solved when they are first needed."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import partial
from threading import Lock

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.basis import basis_with
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.entries import finite, solved_entry
from l2m_gtsam.maps.harmonic.evidence import Weights, condition
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.local import local_hyperparameters
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.harmonic.tile_sums import tile_normal
from l2m_gtsam.maps.harmonic.triangular import TriangularFactor, count
from l2m_gtsam.maps.tile_store import NO_STORE, Arrays, Entry, TileStore
from l2m_gtsam.maps.trained import first_complaint

MEMORY = 2_000_000_000  # bytes of the tiles' covariances that are kept
NAMES = tuple(sorted(Hyperparameters.model_fields))


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
        self, learnt: Learnt, kept: Mapping[int, Tile] | None = None, store: TileStore = NO_STORE
    ) -> None:
        self.store = store
        self._learnt = learnt
        self._solved: OrderedDict[int, Tile] = OrderedDict(kept or {})
        self._held = sum(tile.nbytes for tile in self._solved.values())
        self._entries: dict[int, Entry] = {}
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
        entry = self.entry(index)
        found = self.store.recall(entry, partial(solved_from_arrays, self._learnt, index))
        if found is None:
            found = solved_tile(self._learnt, index)
            self.store.keep(entry, solved_to_arrays(found))
        return found

    def entry(self, index: int) -> Entry:
        """Return what a tile is kept as."""
        found = self._entries.get(index)
        if found is None:  # two threads at once find the same
            found = self._entries[index] = solved_entry(self._learnt, index)
        return found

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
    basis, given = learnt.basis(index, rows), learnt.hyperparameters
    normal = tile_normal(learnt, index, basis)
    if learnt.poses is not None:
        # How far an error of position matters is seen where poses count as exact.
        plain = condition(normal, basis.prior(given).log_variance, given.noise)
        _, gradient = basis.field_and_gradient(learnt.readings[rows].points, plain.mean)
        normal = tile_normal(learnt, index, basis, gradient=gradient)
    own = local_hyperparameters(basis, normal, learnt.hyperparameters, learnt.local)
    weights = condition(normal, basis.prior(own).log_variance, own.noise)
    return Tile(basis, weights, own, learnt.resolution)


def solved_to_arrays(tile: Tile) -> Arrays:
    """Return a tile as arrays."""
    own = tile.hyperparameters
    dipoles = [family for family in tile.basis.families if isinstance(family, Dipoles)]
    return {
        "hyperparameters": np.array([getattr(own, name) for name in NAMES]),
        "mean": tile.weights.mean,
        "prior_sigma": tile.weights.prior_sigma,
        "factor": tile.weights.factor.values,
        # By columns, as they lie in memory: products with them are then the same to the last bit.
        **{f"combinations{k}": each.combinations.T for k, each in enumerate(dipoles)},
    }


def solved_from_arrays(learnt: Learnt, index: int, arrays: Arrays) -> Tile:
    """Return the tile of a map that ``solved_to_arrays`` took apart.

    Raises
    ------
    MapError
        If an array is missing, of the wrong shape, or makes no sense.
    """
    frame = learnt.frame(index)
    basis = basis_with(frame, learnt.resolution, dipoles_from(learnt, index, frame, arrays))
    m = len(basis)
    factor = TriangularFactor(m, finite(arrays, "factor", (count(m),)))
    weights = Weights(finite(arrays, "mean", (m,)), finite(arrays, "prior_sigma", (m,)), factor)
    if not all((block.inverse.diagonal() > 0).all() for block in factor.blocks):
        raise MapError("factor is not that of a covariance")
    return Tile(basis, weights, hyperparameters_from(arrays), learnt.resolution)


def dipoles_from(
    learnt: Learnt, index: int, frame: TileFrame, arrays: Arrays
) -> tuple[Dipoles, ...]:
    """Return the sources of a tile in the combinations that were kept."""
    return tuple(
        Dipoles(
            frame.localise(each.positions),
            finite(arrays, f"combinations{k}", (None, 3 * len(each))).T,
            strength,
        )
        for k, (each, strength) in enumerate(zip(*learnt.structures(index), strict=True))
    )


def hyperparameters_from(arrays: Arrays) -> Hyperparameters:
    """Return the scales and depths of a tile."""
    values = finite(arrays, "hyperparameters", (len(NAMES),))
    try:
        return Hyperparameters(**dict(zip(NAMES, values.tolist(), strict=True)))
    except ValidationError as error:
        raise MapError(first_complaint(error)) from None
