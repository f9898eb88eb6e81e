"""One tile: its basis and the posterior of its weights."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.evidence import Weights
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import clip_rows
from l2m_gtsam.maps.harmonic.modes import left_out
from l2m_gtsam.maps.harmonic.tiling import Resolution

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
