"""The tiles of a map: each a basis and the posterior of its weights, solved when first needed."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from threading import Lock

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.basis import Basis, basis_with, batches
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.entries import finite, solved_entry
from l2m_gtsam.maps.harmonic.evidence import Weights, condition
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import TileFrame, clip_rows
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.local import local_hyperparameters
from l2m_gtsam.maps.harmonic.modes import left_out
from l2m_gtsam.maps.harmonic.tile_sums import tile_normal
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.harmonic.triangular import TriangularFactor, count
from l2m_gtsam.maps.tile_store import NO_STORE, Arrays, Entry, TileStore
from l2m_gtsam.maps.trained import first_complaint

NEAREST = 0.9  # of the distance from the lowest (highest) reading to the sheet of sources
STEP = 1e-3  # metres, of differences: fields vary over decimetres


@dataclass(frozen=True)
class Tile:
    """Posterior of the field in one tile.

    Attributes
    ----------
    basis
        Features of the tile, m weights.
    weights
        Posterior of the m weights.
    hyperparameters
        Scales in uT and depths in metres of the prior.
    resolution
        Modes that were kept; those left out count as variance.
    """

    basis: Basis
    weights: Weights
    hyperparameters: Hyperparameters
    resolution: Resolution

    @property
    def nbytes(self) -> int:
        """Memory of the covariance, by far the most of it, in bytes."""
        return self.weights.factor.nbytes

    def field_and_gradient(self, points: FloatArray) -> FieldAndGradient:
        """Return the mean field (N, 3) in uT and its gradient (N, 3, 3) in uT/m."""
        return self.basis.field_and_gradient(self.within(points), self.weights.mean)

    def within(self, points: FloatArray) -> FloatArray:
        """Return points moved into the box, and no nearer to the sheets of sources than it.

        Beyond, waves repeat themselves or grow without bound. So far from the readings nothing is
        known of the field; the variance at the box's walls is the prior's.
        """
        frame = self.basis.frame
        local = frame.localise(points)
        inside = self.clipped(local)
        moved = frame.corner + inside @ frame.R_map_tile.T
        return np.where((inside == local).all(axis=1)[:, None], points, moved)

    def clipped(self, local: FloatArray) -> FloatArray:
        """Return points in the tile's frame moved into the box; see ``within``."""
        inside = np.empty_like(local)
        clip_rows(local, *self.walls, inside)
        return inside

    @cached_property
    def walls(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates of evaluation in the tile's frame, metres, (3,)."""
        frame, h = self.basis.frame, self.hyperparameters
        low = np.array([0.0, 0.0, -NEAREST * h.floor_depth])
        return low, np.append(frame.size, frame.height + NEAREST * h.ceiling_depth)

    def root_rows(self, points: FloatArray) -> FloatArray:
        """Return ``F L``, whose products are the map's covariance, by weights, uT, (m, 3, N)."""
        return self.weights.root_rows(self.basis, self.within(points))

    def unwhitened(self, directions: FloatArray) -> FloatArray:
        """Return the weights of directions of the posterior's root, both (m, r)."""
        return self.weights.unwhitened(directions)

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the posterior variance per axis in uT^2, shape (N, 3)."""
        variance = np.empty((len(points), 3))
        for at in batches(len(points)):
            root = self.root_rows(points[at])
            variance[at] = np.einsum("min,min->ni", root, root)
        return variance + self.unresolved(points)

    def gradient_beside_field(self, points: FloatArray) -> FloatArray:
        """Return the covariance of the errors of each component and of its gradient, uT^2/m.

        That is half of the slope of the component's variance.

        Returns
        -------
        FloatArray
            By component and direction of the derivative, map frame, shape (N, 3, 3).
        """
        covariance, ones = np.empty((len(points), 3, 3)), np.ones(len(self.basis))
        for at in batches(len(points)):
            inside = self.within(points[at])
            root = self.weights.root_rows(self.basis, inside)
            with_field = self.unwhitened(root.reshape(len(root), -1)).reshape(root.shape)
            for axis, step in enumerate(STEP * np.eye(3)):
                rise = self.basis.rows(inside + step, ones) - self.basis.rows(inside - step, ones)
                covariance[at, :, axis] = np.einsum("min,min->ni", with_field, rise) / (2 * STEP)
        return covariance

    def unresolved(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis that the modes left out hold, uT^2, shape (N, 3)."""
        z = self.basis.frame.localise(self.within(points))[:, 2]
        h = self.hyperparameters
        vertical = left_out(h.floor_scale, h.floor_depth, self.resolution.floor, z)
        over = self.basis.frame.height - z
        vertical = vertical + left_out(
            h.ceiling_scale, h.ceiling_depth, self.resolution.ceiling, over
        )
        # As kx^2 + ky^2 = k^2, both horizontal axes together have the variance of the vertical one.
        local = vertical[:, None] * np.array([0.5, 0.5, 1.0])
        # Diagonal of R diag(v) R^T; correlations between axes are left out.
        return np.asarray(local @ (self.basis.frame.R_map_tile.T**2))


@dataclass(frozen=True)
class TileModes:
    """The error of one tile.

    Attributes
    ----------
    tile
        Tile with the posterior of its m weights.
    weights
        L U: the tile's weights for one unit of each beta, shape (m, r).
    """

    tile: Tile
    weights: FloatArray

    def __len__(self) -> int:
        return int(self.weights.shape[1])

    def features(self, points: FloatArray) -> FloatArray:
        """Return A at points, uT per unit of beta, shape (N, 3, r)."""
        A = np.empty((len(points), 3, len(self)))
        for at in batches(len(points)):
            A[at] = self.rows(points[at]).transpose(2, 1, 0)
        return A

    def rows(self, points: FloatArray) -> FloatArray:
        """Return A at points beta by beta, uT per unit of beta, shape (r, 3, N)."""
        tile = self.tile
        F = tile.basis.rows(tile.within(points), np.ones(len(tile.basis)))
        A = self.weights.T @ F.reshape(len(F), 3 * len(points))
        return np.asarray(A.reshape(len(self), 3, len(points)))


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
