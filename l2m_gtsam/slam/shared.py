"""The map's errors as variables ``M(b)``, shared by readings near each other.

Counted as noise of each reading they would average out as they do not in truth: a vehicle that
stands at one place would seem to learn the place ever better.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from l2m_factors import M, SharedError, map_weights_prior
from l2m_gtsam.calibration.coverage import NothingShared, UncertainMap
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.map_prediction import Sight


@dataclass(frozen=True)
class SharedMapErrors:
    """The map's errors at N readings.

    Attributes
    ----------
    owner
        Tile of each reading, shape (N,); -1 outside of the map.
    features
        Of each tile F of its readings in their order, in the lidar frame in uT, shape (n, 3, r).
    rest
        Variance that stays independent per axis of the map in uT^2, shape (N, 3).
    sizes
        Number of weights of each tile.
    root_information
        Of all weights, shape (K, K).
    """

    owner: IntArray
    features: dict[int, FloatArray]
    rest: FloatArray
    sizes: dict[int, int]
    root_information: FloatArray

    @classmethod
    def over(cls, errors: UncertainMap, sight: Sight) -> "SharedMapErrors":
        """Ask a map for its errors where readings were taken."""
        rows = np.flatnonzero(sight.inside)
        x, R = sight.place.x[rows], sight.place.readings.R_map_lidar[rows]
        told = errors.errors_over(x)
        owner, rest = np.full(len(sight.inside), -1), sight.map_variance.copy()
        owner[rows] = told.owner(x)
        features: dict[int, FloatArray] = {}
        for tile in told.sizes():
            own = np.flatnonzero(owner[rows] == tile)
            A = told.features(x[own], tile)
            held = np.einsum("nir,nir->ni", A, A)
            rest[rows[own]] = np.maximum(rest[rows[own]] - held, 0.0)
            features[tile] = R[own].transpose(0, 2, 1) @ A
        lower = np.linalg.cholesky(told.covariance)
        root = solve_triangular(lower, np.eye(len(lower)), lower=True)
        return cls(owner, features, rest, told.sizes(), root)

    def of(self, rows: IntArray) -> tuple[SharedError, ...]:
        """Return what some readings share: zero for those of other tiles."""
        errors = []
        for tile in np.unique(self.owner[rows]).tolist():
            F = np.zeros((len(rows), 3, self.sizes[tile]))
            own = self.owner[rows] == tile
            place = np.searchsorted(np.flatnonzero(self.owner == tile), rows[own])
            F[own] = self.features[tile][place]
            errors.append(SharedError(M(tile), F))
        return tuple(errors)

    def prior(self) -> gtsam.NonlinearFactor:
        """Return the prior of the weights."""
        return map_weights_prior(self.sizes, self.root_information)

    def values(self) -> gtsam.Values:
        """Return weights of a map without errors."""
        values = gtsam.Values()
        for tile, size in self.sizes.items():
            values.insert(M(tile), np.zeros(size))
        return values


def errors_of(field_map: object) -> UncertainMap:
    """Return what a map knows of its errors: nothing shared if it does not know."""
    return field_map if isinstance(field_map, UncertainMap) else NothingShared()
