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
from numba import njit
from pydantic import Field

from l2m_gtsam.data import FieldAndGradient, FloatArray, IntArray
from l2m_gtsam.options import Options

AXES = 3
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
        found = np.empty((len(points), AXES, len(self)))
        write_features(*self._sines(points), self._distinct.which, self.waves, found)
        return found

    def slopes(self, points: FloatArray) -> FloatArray:
        """Return the derivatives of the features by x, y and z, shape (N, 3, 3, m)."""
        which = self._distinct.which
        S, C = (
            np.stack([own[:, axis, which[axis]] for axis in range(AXES)], axis=1)
            for own in self._sines(points)
        )
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
        if by_features.shape != (len(points), AXES, len(self)):
            msg = f"by_features: {by_features.shape}; needed is {(len(points), AXES, len(self))}"
            raise ValueError(msg)
        found = np.empty((len(points), AXES))
        which = self._distinct.which
        write_by_points(*self._sines(points), which, self.waves, by_features, found)
        return found

    def field_and_gradient(self, points: FloatArray, weights: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m, of weights of shape (m,)."""
        which, w = self._distinct.which, np.asarray(weights, dtype=np.float64)
        if w.shape != (len(self),):
            raise ValueError(f"weights: {w.shape}; needed is {(len(self),)}")
        field, gradient = np.empty((len(points), AXES)), np.empty((len(points), AXES, AXES))
        write_field(*self._sines(points), which, self.waves, w, field, gradient)
        return field, gradient

    def _sines(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return normalised sines and cosines of the distinct waves of each axis, (N, 3, d)."""
        angle = (points - self.low)[:, :, None] * self._distinct.numbers
        norm = np.sqrt(2 / self.size)[:, None]
        return norm * np.sin(angle), norm * np.cos(angle)

    @cached_property
    def _distinct(self) -> "DistinctWaves":
        pairs = [np.unique(own, return_inverse=True) for own in self.waves.T]
        numbers = np.zeros((AXES, max(len(own) for own, _ in pairs)))
        for axis, (own, _) in enumerate(pairs):
            numbers[axis, : len(own)] = own
        return DistinctWaves(numbers, np.stack([which.ravel() for _, which in pairs]))


@dataclass(frozen=True)
class DistinctWaves:
    """Wave numbers of eigenfunctions along each axis: many have the same.

    Attributes
    ----------
    numbers
        Up to d along each axis, rad/m, the rest zeros, shape (3, d).
    which
        Which of them n eigenfunctions have, shape (3, n).
    """

    numbers: FloatArray
    which: IntArray


# Functions that follow write what the methods of their names return. They have sines and cosines
# along each axis as of ``_sines``, ``which`` as of ``DistinctWaves``, and wave numbers (n, 3).


@njit(cache=True, nogil=True)
def write_features(
    S: FloatArray, C: FloatArray, which: IntArray, waves: FloatArray, found: FloatArray
) -> None:
    """Write features, shape (N, 3, n + 3)."""
    for p in range(len(S)):
        for i in range(AXES):
            for j in range(AXES):
                found[p, i, j] = 1.0 if i == j else 0.0
        for m in range(len(waves)):
            a, b, c = which[0, m], which[1, m], which[2, m]
            x, y, z = S[p, 0, a], S[p, 1, b], S[p, 2, c]
            found[p, 0, AXES + m] = waves[m, 0] * C[p, 0, a] * y * z
            found[p, 1, AXES + m] = waves[m, 1] * C[p, 1, b] * x * z
            found[p, 2, AXES + m] = waves[m, 2] * C[p, 2, c] * x * y


@njit(cache=True, nogil=True)
def write_by_points(
    S: FloatArray,
    C: FloatArray,
    which: IntArray,
    waves: FloatArray,
    by_features: FloatArray,
    found: FloatArray,
) -> None:
    """Write derivatives by points, shape (N, 3), of a scalar with those by features."""
    for p in range(len(S)):
        by_x, by_y, by_z = 0.0, 0.0, 0.0
        for m in range(len(waves)):
            a, b, c = which[0, m], which[1, m], which[2, m]
            x, y, z = S[p, 0, a], S[p, 1, b], S[p, 2, c]
            u, v, w = waves[m]
            dx, dy, dz = u * C[p, 0, a], v * C[p, 1, b], w * C[p, 2, c]
            xy, xz, yz, own = dx * dy * z, dx * dz * y, dy * dz * x, -x * y * z
            f, g, h = by_features[p, :, AXES + m]
            by_x += f * u * u * own + g * xy + h * xz
            by_y += f * xy + g * v * v * own + h * yz
            by_z += f * xz + g * yz + h * w * w * own
        found[p, 0], found[p, 1], found[p, 2] = by_x, by_y, by_z


@njit(cache=True, nogil=True)
def write_field(
    S: FloatArray,
    C: FloatArray,
    which: IntArray,
    waves: FloatArray,
    weights: FloatArray,
    field: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the field (N, 3) and its gradient (N, 3, 3)."""
    for p in range(len(S)):
        b, G = field[p], gradient[p]
        b[:], G[:] = weights[:AXES], 0.0
        for m in range(len(waves)):
            i, j, k = which[0, m], which[1, m], which[2, m]
            x, y, z = S[p, 0, i], S[p, 1, j], S[p, 2, k]
            u, v, w = waves[m]
            dx, dy, dz = u * C[p, 0, i], v * C[p, 1, j], w * C[p, 2, k]
            own, product = weights[AXES + m], weights[AXES + m] * x * y * z
            b[0] += own * dx * y * z
            b[1] += own * x * dy * z
            b[2] += own * x * y * dz
            G[0, 0] -= u * u * product
            G[1, 1] -= v * v * product
            G[2, 2] -= w * w * product
            G[0, 1] += own * dx * dy * z
            G[0, 2] += own * dx * y * dz
            G[1, 2] += own * x * dy * dz
        G[1, 0], G[2, 0], G[2, 1] = G[0, 1], G[0, 2], G[1, 2]


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
