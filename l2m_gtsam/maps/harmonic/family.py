"""What every family of features can do: gradients of harmonic potentials, linear in weights."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters


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

    def features(self, points: FloatArray) -> FloatArray:
        """Return the field of each weight at points, in uT per unit weight, shape (N, 3, m)."""

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

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the field (N, 3) in uT and its gradient (N, 3, 3) in uT/m for given weights."""

    def potential(self, points: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the potential phi with ``B = grad phi`` in uT m, shape (N,)."""


def features_of(family: Family, points: FloatArray) -> FloatArray:
    """Return the features of a family point by point, shape (N, 3, m); see ``Family``."""
    rows = np.empty((len(family), 3, len(points)))
    family.write_rows(points, np.ones(len(family)), rows)
    return np.ascontiguousarray(rows.transpose(2, 1, 0))


def no_slopes(variance: float, count: int) -> WeightPrior:
    """Return a prior that depends on no hyperparameter."""
    return WeightPrior(np.full(count, np.log(variance)), {})
