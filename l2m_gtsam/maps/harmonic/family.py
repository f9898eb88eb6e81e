"""What a map learns from its readings, and what every family of its features can do."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FieldAndGradient, FloatArray
from l2m_gtsam.options import Options


class Hyperparameters(Options):
    """Scales of the prior; learnt by the marginal likelihood, for the map and again for each tile.

    The depth of a side is the distance of its sources below the lowest, or above the highest,
    reading; its scale is the standard deviation of their horizontal field there per axis (the
    vertical one is larger by the square root of two).
    """

    floor_scale: float = Field(default=5.0, gt=0)
    """Microtesla."""
    floor_depth: float = Field(default=0.6, gt=0)
    """Metres."""
    ceiling_scale: float = Field(default=1.0, gt=0)
    """Microtesla."""
    ceiling_depth: float = Field(default=2.0, gt=0)
    """Metres."""
    structure_scale: float = Field(default=0.3, gt=0)
    """Standard deviation of each component of a source's moment, in uT m^3: a source of 1 uT m^3
    makes 1-2 uT at a metre."""
    noise: float = Field(default=0.2, gt=0)
    """Standard deviation of a reading per axis in microtesla."""


BOUNDS = {
    "floor_scale": (1e-3, 1e4),
    "floor_depth": (0.03, 30.0),
    "ceiling_scale": (1e-3, 1e4),
    "ceiling_depth": (0.03, 30.0),
    "structure_scale": (1e-5, 1e3),
    "noise": (1e-4, 1e2),
}
"""Where learning looks, in the units above."""


@dataclass(frozen=True)
class WeightPrior:
    """Prior of a family's weights, with its derivatives by the logarithms of hyperparameters.

    Attributes
    ----------
    log_variance
        Logarithm of the prior variance of each weight, shape (m,).
    slopes
        Derivative of it by the logarithm of a hyperparameter, by that one's name, shape (m,).
    """

    log_variance: FloatArray
    slopes: dict[str, FloatArray]


class Family(Protocol):
    """Features over one tile; points are in the tile's frame in metres, shape (N, 3)."""

    def __len__(self) -> int:
        """Return the number m of weights."""

    def prior(self, hyperparameters: Hyperparameters) -> WeightPrior:
        """Return the prior of the weights."""

    def write_rows(self, points: FloatArray, units: FloatArray, rows: FloatArray) -> None:
        """Write the field that so many units of each weight make at points.

        Parameters
        ----------
        points
            In the tile's frame in metres, shape (N, 3).
        units
            Factor of each weight's field, shape (m,).
        rows
            For the field in uT, one weight after the other, shape (m, 3, N), in C order.
        """

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return the field (N, 3) in uT and its gradient (N, 3, 3) in uT/m for given weights."""


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
        return WeightPrior(np.full(3, np.log(self.sigma**2)), {})

    def write_rows(self, points: FloatArray, units: FloatArray, rows: FloatArray) -> None:
        """Write the same for all points; see ``Family``."""
        rows[:] = np.diag(units)[:, :, None]

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return field and gradient; see ``Family``."""
        return np.tile(weights, (len(points), 1)), np.zeros((len(points), 3, 3))

    def by_points(self, points: FloatArray, _: FloatArray) -> FloatArray:
        """Return the derivative of a scalar by points, none, shape (N, 3)."""
        return np.zeros_like(points)

    def potential_on(
        self, x: FloatArray, y: FloatArray, z: FloatArray, weights: FloatArray
    ) -> FloatArray:
        """Return the potential in uT m at the nodes of these axes, shape (nx, ny, nz)."""
        x, y, z = np.ix_(weights[0] * x, weights[1] * y, weights[2] * z)
        return np.asarray(x + y + z)
