r"""Noise of a tile's readings of which a part is shared: errors of the poses that last.

With E what independent errors do to the readings, the noise has the covariance

.. math::
    N = \sigma^2 W^{-1} + E E^T, \qquad
    \sigma^2 N^{-1} = W - U^T U, \quad U = K^{-1} E^T W / \sigma, \quad
    K K^T = 1 + E^T W E / \sigma^2
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_gtsam.data import FloatArray


@dataclass(frozen=True)
class SharedNoise:
    """The part that n readings share.

    Attributes
    ----------
    errors
        E in uT, shape (n, 3, q).
    weight
        W of each reading, shape (n,).
    noise
        Standard deviation of a reading of weight one by itself, uT.
    """

    errors: FloatArray
    weight: FloatArray
    noise: float

    @cached_property
    def root(self) -> FloatArray:
        """K, lower triangular, shape (q, q)."""
        weighted = (self.errors * self.weight[:, None, None]).reshape(-1, self.errors.shape[2])
        inner = self.errors.reshape(weighted.shape).T @ weighted / self.noise**2
        inner[np.diag_indices_from(inner)] += 1.0
        return np.asarray(cholesky(inner, lower=True, check_finite=False))

    @property
    def log_determinant(self) -> float:
        """Of ``N``, beyond that of the white part."""
        return 2 * float(np.log(np.diag(self.root)).sum())

    def rows(self, at: slice, weighted: FloatArray) -> FloatArray:
        """Return ``E^T`` of some readings times what is weighted by W, (n, 3, k): shape (q, k)."""
        E = self.errors[at].reshape(-1, self.errors.shape[2])
        return np.asarray(E.T @ weighted.reshape(len(E), -1))

    def taken(self, crossed: FloatArray) -> FloatArray:
        """Return ``U X`` of ``E^T W X``, both of shape (q, k)."""
        return np.asarray(
            solve_triangular(self.root, crossed / self.noise, lower=True, check_finite=False)
        )

    def given(self, values: FloatArray) -> FloatArray:
        """Return ``sigma^2 N^-1 X`` for X, both of shape (n, 3, k)."""
        weighted = values * self.weight[:, None, None]
        taken = self.taken(self.rows(slice(None), weighted))
        back = solve_triangular(self.root, taken, lower=True, trans=1, check_finite=False)
        E = self.errors.reshape(-1, self.errors.shape[2])
        shared = (E @ back).reshape(values.shape) / self.noise
        return np.asarray(weighted - shared * self.weight[:, None, None])
