"""The uniform field: three weights, one per axis."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.family import WeightPrior, features_of, no_slopes
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters


@dataclass(frozen=True)
class UniformField:
    """The same field everywhere.

    Attributes
    ----------
    sigma
        Prior standard deviation per axis in microtesla; wide, so that the data determine the field.
    """

    sigma: float

    def __len__(self) -> int:
        return 3

    def prior(self, hyperparameters: Hyperparameters) -> WeightPrior:
        """Return the prior of the weights; see ``Family``."""
        return no_slopes(self.sigma**2, 3)

    def features(self, points: FloatArray) -> FloatArray:
        """Return one unit per axis; see ``Family``."""
        return features_of(self, points)

    def write_rows(self, points: FloatArray, units: FloatArray, rows: FloatArray) -> None:
        """Write the same for all points; see ``Family``."""
        rows[:] = np.diag(units)[:, :, None]

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient; see ``Family``."""
        return np.tile(weights, (len(points), 1)), np.zeros((len(points), 3, 3))

    def potential(self, points: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the potential; see ``Family``."""
        return np.asarray(points @ weights)

    def potential_on(
        self, x: FloatArray, y: FloatArray, z: FloatArray, weights: FloatArray
    ) -> FloatArray:
        """Return the potential in uT m at the nodes of these axes, shape (nx, ny, nz)."""
        x, y, z = np.ix_(weights[0] * x, weights[1] * y, weights[2] * z)
        return np.asarray(x + y + z)
