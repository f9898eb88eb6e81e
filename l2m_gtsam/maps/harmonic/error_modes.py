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
share it gives their covariance. The other part, the prior's, counts as independent between tiles:
it is a sixth of the variance in an office corridor, and what neighbours have of it in common moved
no standard deviation of a calibrated place by one per cent.

Errors of the sensors that surveyed are wrong readings, ``E eta``, with one eta for the whole map.
They move the posterior mean of every tile by ``dw_b = L L^T F^T W E eta / sigma^2``, a field that
no tile's own posterior knows of. A shift d of all readings alike is taken out of E before: it moves
the map as it is, by ``-G d``, since its prior was learnt from the shifted readings, too.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpstrf

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.grid import Grid
from l2m_gtsam.maps.harmonic.learnt import ErrorOptions, Learnt
from l2m_gtsam.maps.harmonic.tile_correlation import joint_covariance
from l2m_gtsam.maps.harmonic.tile_sums import tile_pull
from l2m_gtsam.maps.harmonic.tiles import Tile, TileModes, Tiles
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.solve.linear_algebra import covariance_root

NEGLIGIBLE = 1e-11  # share of the variance at places
LINEAR = 0.002  # metres over which a field that varies over decimetres is linear
NOTICEABLE = 0.01  # of the noise, rms over a drive: what matters to ten thousand readings


@dataclass(frozen=True)
class SuiteModes:
    """The error that the survey's sensors brought into a map, as s numbers.

    Attributes
    ----------
    weights
        Of each tile for one unit of each, shape (m, s).
    shift
        Of the map as a whole, metres in the map frame, shape (3, s).
    spread
        Standard deviation of each, shape (s,): one, or more where a deviation of the whole would
        shift the map further than its field is linear.
    """

    weights: dict[int, FloatArray]
    shift: FloatArray
    spread: FloatArray

    def features(self, modes: TileModes, points: FloatArray, tile: int) -> FloatArray:
        """Return what a unit of each does to a tile at points beside the shift, uT, (N, 3, s)."""
        if not self.shift.shape[1]:
            return np.empty((len(points), 3, 0))
        return replace(modes, weights=self.weights[tile]).features(points)

    def among(self, chosen: FloatArray) -> "SuiteModes":
        """Return other numbers, of which each is a combination of these, shape (s, k)."""
        spread = np.maximum(np.linalg.norm(self.shift @ chosen, axis=0) / LINEAR, 1.0)
        chosen = chosen / spread
        weights = {tile: each @ chosen for tile, each in self.weights.items()}
        return SuiteModes(weights, self.shift @ chosen, spread)


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
    suite
        What the survey's sensors brought into all of the map.
    """

    grid: Grid
    tiles: dict[int, TileModes]
    covariance: FloatArray
    suite: SuiteModes

    @property
    def spread(self) -> FloatArray:
        """Standard deviations of the s errors of the survey's sensors, one at least."""
        return self.suite.spread

    @property
    def shift(self) -> FloatArray:
        """How far a unit of each of them moves the map as a whole, metres, shape (3, s)."""
        return self.suite.shift

    def sizes(self) -> dict[int, int]:
        """Return the number of beta of each tile."""
        return {tile: len(modes) for tile, modes in self.tiles.items()}

    def owner(self, points: FloatArray) -> IntArray:
        """Return the tile whose beta act at each point: of those with modes the nearest, (N,)."""
        if not len(points):  # then no tile has modes
            return np.empty(0, dtype=np.int64)
        known = np.array(list(self.tiles))
        near = Grid(self.grid.origin, self.grid.size, self.grid.cells[known])
        return np.asarray(known[near.block_of(points)])

    def features(self, points: FloatArray, tile: int) -> FloatArray:
        """Return A of a tile at points, shape (N, 3, r)."""
        return self.tiles[tile].features(points)

    def common_features(self, points: FloatArray, tile: int) -> FloatArray:
        """Return what they do to a tile beside that shift, uT, shape (N, 3, s)."""
        return self.suite.features(self.tiles[tile], points, tile)


class MovedTiles:
    """What errors of the survey's sensors do to the tiles of a map: found once for each tile.

    It takes as long as all else that is asked of the errors over a drive, and does not depend on
    the drive.

    Parameters
    ----------
    learnt
        Prior and readings of the map.
    """

    def __init__(self, learnt: Learnt) -> None:
        self._learnt = learnt
        self._known: dict[int, FloatArray] = {}

    def __reduce__(self) -> tuple[type["MovedTiles"], tuple[Learnt]]:
        return MovedTiles, (self._learnt,)

    @cached_property
    def root(self) -> FloatArray:
        """Root of the covariance of the 16 errors of each of S sensors, shape (16 S, q)."""
        suite = self._learnt.suite
        # Singular, where errors are known or the same.
        return np.empty((0, 0)) if suite is None else covariance_root(suite.covariance)

    @cached_property
    def shift(self) -> FloatArray:
        """How far they move the map as a whole, metres, shape (3, 16 S)."""
        suite, weight = self._learnt.suite, self._learnt.readings.weight
        return np.empty((3, 0)) if suite is None else suite.mean_shift(weight)

    def weights(self, index: int, tile: Tile) -> FloatArray:
        """Return what units of the root's columns do to a tile beside that, shape (m, q)."""
        found, suite = self._known.get(index), self._learnt.suite
        if suite is None:
            return np.empty((len(tile.basis), 0))
        if found is None:  # two threads at once find the same
            moved = moved_weights(self._learnt, suite, index, tile, self.shift)
            found = self._known[index] = np.asarray(moved @ self.root)
        return found


def error_modes(
    learnt: Learnt, tiles: Tiles, moved: MovedTiles, points: FloatArray, options: ErrorOptions
) -> ErrorModes:
    """Return the error of a map over places.

    Parameters
    ----------
    learnt, tiles, moved
        Prior and readings of the map, its solved tiles, and what the survey's sensors do to them.
    points
        Where a drive reads the field, metres, shape (N, 3).
    options
        Number of places and share of variance left out.
    """
    owner = learnt.tiling.grid.block_of(points)
    crossed = np.unique(owner).tolist()

    def modes(index: int) -> TileModes:
        return tile_modes(tiles[index], points[owner == index], options)

    found = dict(zip(crossed, in_threads(modes, crossed), strict=True))
    suite = suite_modes(learnt, found, moved, points, owner, options)
    return ErrorModes(learnt.tiling.grid, found, joint_covariance(learnt, found), suite)


def tile_modes(tile: Tile, points: FloatArray, options: ErrorOptions) -> TileModes:
    """Return the error of a tile over places in it, shape (N, 3)."""
    some = np.linspace(0, len(points) - 1, min(options.places, len(points))).astype(int)
    directions = leading(tile.root_rows(points[some]), options.rest)
    return TileModes(tile, tile.unwhitened(directions))


def suite_modes(
    learnt: Learnt,
    tiles: dict[int, TileModes],
    moved: MovedTiles,
    points: FloatArray,
    owner: IntArray,
    options: ErrorOptions,
) -> SuiteModes:
    """Return what errors of the survey's sensors do over places, as numbers of unit variance.

    Of their sixteen errors each, the combinations stay that a drive shows.
    """
    if learnt.suite is None or not tiles:
        return SuiteModes({}, np.empty((3, 0)), np.empty(0))

    def of_tile(index: int) -> FloatArray:
        return moved.weights(index, tiles[index].tile)

    weights, root = dict(zip(tiles, in_threads(of_tile, list(tiles)), strict=True)), moved.root
    every = SuiteModes(weights, moved.shift @ root, np.ones(len(root)))
    gram = np.zeros((len(root), len(root)))
    for index, each in tiles.items():
        rows = np.flatnonzero(owner == index)
        some = rows[np.linspace(0, len(rows) - 1, min(options.places, len(rows))).astype(int)]
        at = points[some]
        _, gradient = each.tile.field_and_gradient(at)
        seen = every.features(each, at, index) - gradient @ every.shift
        seen = seen.reshape(-1, len(root))
        gram += seen.T @ seen * (len(rows) / len(some))
    squares, turned = np.linalg.eigh(gram)
    least = 3 * len(points) * (NOTICEABLE * learnt.hyperparameters.noise) ** 2
    return every.among(turned[:, squares > least])


def moved_weights(
    learnt: Learnt, suite: SuiteErrors, index: int, tile: Tile, shift: FloatArray
) -> FloatArray:
    """Return what a unit of each error of the survey's sensors does to a tile, (m, 16 S).

    The ``shift`` of all readings, (3, 16 S) metres, is left out.
    """
    rows = learnt.members[index]
    readings = learnt.readings[rows]
    _, gradient = tile.field_and_gradient(readings.points)
    wrong = suite.of_field(rows, gradient) + gradient @ shift
    pulled = tile_pull(learnt, index, tile.basis, wrong, gradient)
    # L L^T by the factor: neither covariance nor inverse is formed.
    white = np.ascontiguousarray(pulled * tile.weights.prior_sigma[:, None])
    tile.weights.factor.solve_rows(white)
    return np.asarray(tile.unwhitened(white) / tile.hyperparameters.noise**2)


def leading(root: FloatArray, rest: float) -> FloatArray:
    """Return the directions of a posterior's root that hold all but a share of the variance.

    Parameters
    ----------
    root
        ``F L`` at places, weight by weight, shape (m, 3, N).
    rest
        Share that may be left out.
    """
    rows = root.reshape(len(root), root.shape[1] * root.shape[2])
    # By the smaller of the two Gram matrices: few places, many weights. Neighbours know much the
    # same: its Cholesky factor, the largest pivots first, has few columns.
    gram = rows.T @ rows
    factor, pivots, rank, _ = dpstrf(gram, tol=NEGLIGIBLE * np.trace(gram), lower=1)
    factor = np.tril(factor)[:, :rank]
    squares, turned = np.linalg.eigh(factor.T @ factor)
    squares, turned = np.maximum(squares[::-1], 0.0), turned[:, ::-1]
    held = np.cumsum(squares) / np.sum(squares)
    count = int(np.searchsorted(held, 1 - rest)) + 1
    left = np.empty((len(gram), count))
    left[pivots - 1] = factor @ turned[:, :count]
    return np.asarray(rows @ left / squares[:count])
