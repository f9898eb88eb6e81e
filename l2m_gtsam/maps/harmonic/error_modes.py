r"""The map's error over the places of a drive, as few correlated numbers.

A posterior of hundreds of weights in each tile is more than a drive can see. Over given places,

.. math::
    B_{true}(x) = B_{map}(x) + A_b(x) \beta_b + \text{rest}

with ``A_b = F L U``: the posterior's root L of the tile b that x lies in, turned so that its
first columns U hold most of the variance at these places; each ``beta`` has unit variance. The
rest, a few per cent of the variance, is independent from place to place as far as the drive is
concerned.

Tiles share readings, so their errors are correlated. The part of ``beta`` that the survey's noise
makes is ``-A_b(X)^T W n / sigma^2`` at the survey's places X; over the readings that two tiles
share it gives their covariance. The other part, the prior's, counts as independent between tiles.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.grid import Grid
from l2m_gtsam.maps.harmonic.basis import batches
from l2m_gtsam.maps.harmonic.error_options import ErrorOptions
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.tile import Tile
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.threads import in_threads


@dataclass(frozen=True)
class TileModes:
    """The error of one tile.

    Attributes
    ----------
    tile
        What the tile knows.
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
            A[at] = self.tile.basis.features(self.tile.within(points[at])) @ self.weights
        return A


@dataclass(frozen=True)
class ErrorModes:
    """The map's error over a drive.

    Attributes
    ----------
    grid
        Says which tile answers at a place.
    tiles
        Modes of each tile that the drive crosses, by the tile's index.
    covariance
        Of all beta together, tile by tile in their order, shape (K, K).
    """

    grid: Grid
    tiles: dict[int, TileModes]
    covariance: FloatArray

    def sizes(self) -> dict[int, int]:
        """Return the number of beta of each tile."""
        return {tile: len(modes) for tile, modes in self.tiles.items()}

    def owner(self, points: FloatArray) -> IntArray:
        """Return the tile whose beta act at each point: of those with modes the nearest, (N,)."""
        known = np.array(list(self.tiles))
        near = Grid(self.grid.origin, self.grid.size, self.grid.cells[known])
        return np.asarray(known[near.block_of(points)])

    def features(self, points: FloatArray, tile: int) -> FloatArray:
        """Return A of a tile at points, shape (N, 3, r)."""
        return self.tiles[tile].features(points)


def error_modes(
    learnt: Learnt, tiles: Tiles, points: FloatArray, options: ErrorOptions
) -> ErrorModes:
    """Return the error of a map over places.

    Parameters
    ----------
    learnt, tiles
        The map.
    points
        Where a drive reads the field, metres, shape (N, 3).
    options
        How finely.
    """
    owner = learnt.tiling.grid.block_of(points)
    crossed = np.unique(owner).tolist()

    def modes(index: int) -> TileModes:
        rows = np.flatnonzero(owner == index)
        some = rows[np.linspace(0, len(rows) - 1, min(options.places, len(rows))).astype(int)]
        directions = leading(tiles[index].root(points[some]), options.rest)
        return TileModes(tiles[index], tiles[index].unwhitened(directions))

    found = dict(zip(crossed, in_threads(modes, crossed), strict=True))
    return ErrorModes(learnt.tiling.grid, found, joint_covariance(learnt, found))


def leading(root: FloatArray, rest: float) -> FloatArray:
    """Return the directions of a posterior's root that hold all but a share of the variance.

    Parameters
    ----------
    root
        ``F L`` at places, shape (N, 3, m).
    rest
        Share that may be left out.
    """
    rows = root.reshape(-1, root.shape[2])
    # By the smaller of the two Gram matrices: few places, many weights.
    squares, left = np.linalg.eigh(rows @ rows.T)
    squares, left = np.maximum(squares[::-1], 0.0), left[:, ::-1]
    held = np.cumsum(squares) / np.sum(squares)
    count = int(np.searchsorted(held, 1 - rest)) + 1
    return np.asarray(rows.T @ left[:, :count] / np.sqrt(squares[:count]))


def joint_covariance(learnt: Learnt, tiles: dict[int, TileModes]) -> FloatArray:
    """Return the covariance of all beta: one in each tile, and what shared readings correlate."""
    members, readings = learnt.members, learnt.readings
    scale = np.sqrt(readings.weight) / learnt.hyperparameters.noise
    indices = list(tiles)

    def seen(index: int) -> FloatArray:
        rows = members[index]
        A = tiles[index].features(readings.points[rows])
        return np.asarray(A * scale[rows, None, None])

    whitened = dict(zip(indices, in_threads(seen, indices), strict=True))
    starts = np.cumsum([0, *(len(modes) for modes in tiles.values())])
    covariance = np.eye(int(starts[-1]))
    for i, a in enumerate(indices):
        for j, b in enumerate(indices[:i]):
            _, in_a, in_b = np.intersect1d(members[a], members[b], return_indices=True)
            if len(in_a):
                shared = np.einsum(
                    "nir,nis->rs", whitened[a][in_a], whitened[b][in_b], optimize=True
                )
                covariance[starts[i] : starts[i + 1], starts[j] : starts[j + 1]] = shared
                covariance[starts[j] : starts[j + 1], starts[i] : starts[i + 1]] = shared.T
    return covariance
