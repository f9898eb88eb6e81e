r"""A field without curl in a box: a Gaussian process of the scalar potential, of reduced rank.

The potential has a squared exponential covariance. Eigenfunctions of the Laplacian that vanish on
the faces of the box approximate it (Hilbert-space approximation: A. Solin, S. Särkkä, 2020; for
magnetic fields M. Kok, A. Solin, 2018):

.. math::
    \phi_j(x) = \prod_i \sqrt{2 / L_i} \sin(w_{ji} (x_i - l_i)), \quad
    B(x) = u_0 + \sum_j u_j \nabla \phi_j(x)

with independent weights, whose variances are the spectral density at the eigenfunction's wave
number. The uniform field ``u_0`` has three weights of its own.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FieldAndGradient, FloatArray, IntArray
from l2m_gtsam.options import Options

AXES = 3
OTHERS = ((1, 2), (0, 2), (0, 1))
PAIRS = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # two axes and the third


class PotentialHyperparameters(Options):
    """The covariance of a potential, and of the uniform field beside it."""

    sigma: float = Field(gt=0)
    """Standard deviation of the potential in uT m,"""
    length: float = Field(gt=0)
    """and the distance over which it varies, m."""
    uniform: float = Field(default=50.0, gt=0)
    """Standard deviation of the uniform field per axis in uT."""


@dataclass(frozen=True)
class PotentialBasis:
    """The uniform field and n eigenfunctions in a box: m = n + 3 weights.

    Attributes
    ----------
    low, size
        Lower corner and edges of the box in metres, shape (3,).
    waves
        Wave numbers w in rad/m, shape (n, 3), from the largest prior variance on.
    variance
        Prior variance of all weights, those of the uniform field first, shape (m,).
    """

    low: FloatArray
    size: FloatArray
    waves: FloatArray
    variance: FloatArray

    @classmethod
    def over(
        cls, low: FloatArray, high: FloatArray, prior: PotentialHyperparameters, count: int
    ) -> "PotentialBasis":
        """Return the eigenfunctions of the largest prior variance.

        Parameters
        ----------
        low, high
            Corners of the box in metres, shape (3,).
        prior
            Of the potential.
        count
            How many eigenfunctions.
        """
        size = np.asarray(high - low, dtype=np.float64)
        waves = smallest_waves(size, count)
        made = cls(np.asarray(low, dtype=np.float64), size, waves, np.empty(0))
        return replace(made, variance=made.variances(prior))

    def variances(self, prior: PotentialHyperparameters) -> FloatArray:
        """Return the variances of the weights by a prior, shape (m,)."""
        squared = np.einsum("ni,ni->n", self.waves, self.waves) * prior.length**2
        density = (2 * np.pi * prior.length**2) ** 1.5 * np.exp(-0.5 * squared)
        uniform = np.full(AXES, prior.uniform**2)
        return np.concatenate([uniform, prior.sigma**2 * density])

    def __len__(self) -> int:
        return len(self.variance)

    def features(self, points: FloatArray) -> FloatArray:
        """Return the field of each weight at points (N, 3) in metres, shape (N, 3, m)."""
        S, C = self._sines(points)
        found = np.empty((len(points), AXES, len(self)))
        found[:, :, :AXES] = np.eye(AXES)
        for i, (j, k) in enumerate(OTHERS):
            found[:, i, AXES:] = self.waves[:, i] * C[:, i] * S[:, j] * S[:, k]
        return found

    def slopes(self, points: FloatArray) -> FloatArray:
        """Return the derivatives of the features by x, y and z, shape (N, 3, 3, m)."""
        S, C = self._sines(points)
        found = np.zeros((len(points), AXES, AXES, len(self)))
        product = S[:, 0] * S[:, 1] * S[:, 2]
        for i in range(AXES):
            found[:, i, i, AXES:] = -(self.waves[:, i] ** 2) * product
        for i, j, k in PAIRS:
            mixed = self.waves[:, i] * self.waves[:, j] * C[:, i] * C[:, j] * S[:, k]
            found[:, i, j, AXES:] = found[:, j, i, AXES:] = mixed
        return found

    def by_points(self, points: FloatArray, by_features: FloatArray) -> FloatArray:
        """Return the derivative of a scalar by points, shape (N, 3).

        Parameters
        ----------
        points
            In metres, shape (N, 3).
        by_features
            Its derivative by the features there, shape (N, 3, m).
        """
        S, C = self._sines(points)
        by, w, found = by_features[:, :, AXES:], self.waves, np.empty_like(points)
        product = S[:, 0] * S[:, 1] * S[:, 2]
        for i in range(AXES):
            found[:, i] = -(by[:, i] * product) @ w[:, i] ** 2
        for i, j, k in PAIRS:
            mixed = w[:, i] * w[:, j] * C[:, i] * C[:, j] * S[:, k]
            found[:, j] += np.einsum("nm,nm->n", by[:, i], mixed)
            found[:, i] += np.einsum("nm,nm->n", by[:, j], mixed)
        return found

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m, of weights of shape (m,)."""
        return self.features(points) @ weights, self.slopes(points) @ weights

    def _sines(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return normalised sines and cosines along each axis, shape (N, 3, n)."""
        S, norm = np.empty((len(points), AXES, len(self.waves))), np.sqrt(2 / self.size)
        C = np.empty_like(S)
        for axis, (numbers, own) in enumerate(self._distinct):
            angle = np.outer(points[:, axis] - self.low[axis], numbers)
            S[:, axis] = (norm[axis] * np.sin(angle))[:, own]
            C[:, axis] = (norm[axis] * np.cos(angle))[:, own]
        return S, C

    @cached_property
    def _distinct(self) -> tuple[tuple[FloatArray, IntArray], ...]:
        """The distinct wave numbers along each axis, and which of them each eigenfunction has."""
        pairs = (np.unique(own, return_inverse=True) for own in self.waves.T)
        return tuple((numbers, which.ravel()) for numbers, which in pairs)


def smallest_waves(size: FloatArray, count: int) -> FloatArray:
    """Return the smallest wave numbers of a box's eigenfunctions in rad/m, shape (count, 3)."""
    # Along an axis none is more than ``count``: all smaller ones would come before it.
    base = (np.pi / size) ** 2
    limit = int(np.ceil(count ** (1 / 3))) + 1
    while True:
        # Complete below the smallest wave that the lattice leaves out.
        reach = np.sqrt((base.sum() + (limit**2 - 1) * base.max()) / base)
        most = np.minimum(np.ceil(reach).astype(np.int64), count)
        axes = [np.arange(1, each + 1) for each in most]
        numbers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, AXES)
        squared = numbers**2 @ base
        complete = numbers[squared <= base.sum() + (limit**2 - 1) * base.max()]
        if len(complete) >= count:
            order = np.argsort(complete**2 @ base, kind="stable")[:count]
            return np.asarray(np.pi / size * complete[order])
        limit *= 2
