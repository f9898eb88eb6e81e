"""Errors of the map that readings of a drive share: variables ``M(b)`` of its graph.

Counted as independent noise of each reading they would average out, which they do not: a parked
vehicle would seem to learn its place ever better.

Tiles that share readings of the survey have correlated errors. All tiles of a large map at once
would make a dense system that grows with the square of the area. They are grouped by place
therefore, and errors of different groups count as independent: at the borders between groups alone
that is not so.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import block_diag, solve_triangular

from l2m_factors import M, SharedError, map_weights_prior
from l2m_gtsam.calibration.coverage import MapErrors, NothingShared, UncertainMap
from l2m_gtsam.calibration.extent import TiledMap
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.map_prediction import MapPrediction

MOST_TILES = 40  # of a group: some 1,000 weights


@dataclass(frozen=True)
class TileGroup:
    """Tiles whose errors are correlated.

    Attributes
    ----------
    sizes
        Number of weights of each tile.
    root_information
        Of all K weights, tile by tile, shape (K, K).
    """

    sizes: dict[int, int]
    root_information: FloatArray

    @classmethod
    def of(cls, errors: MapErrors) -> "TileGroup":
        """Return the tiles of a map's errors."""
        lower = np.linalg.cholesky(errors.covariance)
        return cls(errors.sizes(), solve_triangular(lower, np.eye(len(lower)), lower=True))


@dataclass(frozen=True)
class SharedMapErrors:
    """The map's errors at N readings.

    Attributes
    ----------
    owner
        Tile of each reading, shape (N,); -1 outside of the map.
    place
        Which of its tile's readings each is, shape (N,).
    features
        Of each tile F of its readings in their order, in the lidar frame in uT, shape (n, 3, r).
    rest
        Variance that stays independent per axis of the map in uT^2, shape (N, 3).
    groups
        All tiles.
    """

    owner: IntArray
    place: IntArray
    features: dict[int, FloatArray]
    rest: FloatArray
    groups: tuple[TileGroup, ...]

    @classmethod
    def over(cls, errors: UncertainMap, prediction: MapPrediction) -> "SharedMapErrors":
        """Return a map's errors at readings."""
        rows = np.flatnonzero(prediction.inside)
        x, R = prediction.placed.x, prediction.placed.readings.R_map_lidar
        owner, rest = np.full(len(prediction.inside), -1), prediction.map_variance.copy()
        place, features, groups = np.zeros_like(owner), dict[int, FloatArray](), []
        for part in by_place(errors, x[rows], MOST_TILES):
            here = rows[part]
            found = errors.errors_over(x[here])
            owner[here] = found.owner(x[here])
            for tile in found.sizes():
                own = here[owner[here] == tile]
                A = found.features(x[own], tile)
                # The weights carry A A^T of the variance; what they leave is noise of each
                # reading: nothing counts twice.
                held = np.einsum("nir,nir->ni", A, A)
                rest[own] = np.maximum(rest[own] - held, 0.0)
                features[tile] = R[own].transpose(0, 2, 1) @ A
                place[own] = np.arange(len(own))
            groups.append(TileGroup.of(found))
        return cls(owner, place, features, rest, tuple(groups))

    @property
    def sizes(self) -> dict[int, int]:
        """Number of weights of each tile, group by group."""
        return {tile: size for group in self.groups for tile, size in group.sizes.items()}

    @property
    def root_information(self) -> FloatArray:
        """Of all K weights, tile by tile as ``sizes`` has them, shape (K, K)."""
        return np.asarray(block_diag(*(group.root_information for group in self.groups)))

    def of(self, rows: IntArray) -> tuple[SharedError, ...]:
        """Return the shared errors of some readings: zero for readings of other tiles."""
        errors = []
        for tile in np.unique(self.owner[rows]).tolist():
            features = self.features[tile]
            F = np.zeros((len(rows), *features.shape[1:]))
            own = self.owner[rows] == tile
            F[own] = features[self.place[rows[own]]]
            errors.append(SharedError(M(tile), F))
        return tuple(errors)

    def prior(self) -> gtsam.NonlinearFactorGraph:
        """Return the prior of all weights: a factor of each group."""
        graph = gtsam.NonlinearFactorGraph()
        for group in self.groups:
            graph.add(map_weights_prior(group.sizes, group.root_information))
        return graph

    def values(self) -> gtsam.Values:
        """Return zero weights: a map without errors."""
        values = gtsam.Values()
        for tile, size in self.sizes.items():
            values.insert(M(tile), np.zeros(size))
        return values


def by_place(errors: UncertainMap, points: FloatArray, most: int) -> Iterator[IntArray]:
    """Yield the rows of points in neighbouring tiles, no more of these than so many.

    Parameters
    ----------
    errors
        A map; one without tiles is a single one.
    points
        In the map, metres, shape (N, 3).
    most
        Tiles of a group.
    """
    every = np.arange(len(points))
    if not isinstance(errors, TiledMap) or not len(points):
        yield every
        return
    _, tile = np.unique(errors.tile_of(points), return_inverse=True)
    tile = tile.ravel()
    count = np.bincount(tile)
    centre = np.stack([np.bincount(tile, axis) / count for axis in points.T[:2]], axis=1)
    for group in halved(np.arange(len(centre)), centre, most):
        yield every[np.isin(tile, group)]


def halved(tiles: IntArray, centre: FloatArray, most: int) -> Iterator[IntArray]:
    """Yield tiles, halved across the longer side of where they are until they are few enough."""
    if len(tiles) <= most:
        yield tiles
        return
    longer = int(np.ptp(centre[tiles], axis=0).argmax())
    order = tiles[np.argsort(centre[tiles, longer], kind="stable")]
    for half in np.array_split(order, 2):
        yield from halved(half, centre, most)


def errors_of(field_map: object) -> UncertainMap:
    """Return a map's model of its errors; without one no error is shared."""
    return field_map if isinstance(field_map, UncertainMap) else NothingShared()
