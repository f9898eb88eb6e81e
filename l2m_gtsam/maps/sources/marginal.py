r"""What averaged readings say of a change of the field, with all that else is open taken out.

With e what readings differ from the map by, D b the change that is asked for, X n errors with a
prior (of the map, of sensors, of the suite that surveyed) and white noise,

.. math::
    e = D b + X n + v, \quad n \sim N(0, \Lambda^{-1}), \quad v \sim N(0, (V^T V)^{-1})

the precision of e without n is that of Woodbury's identity: no matrix of all readings is formed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.sparse import csr_array, hstack

from l2m_gtsam.data import BoolArray, FloatArray, IntArray

AXES = 3
ANYTHING_UT = 1e4  # that a wrong reading may be off by


@dataclass(frozen=True)
class MarginalRows:
    """N averaged readings and their noise, in the frame of the map.

    Attributes
    ----------
    points
        Where they were taken in metres, shape (N, 3).
    residual
        What they differ from the map by in uT, shape (N, 3).
    whitening
        V in 1/uT, block diagonal, shape (3 N, 3 N).
    nuisance
        V X, shape (3 N, K).
    prior
        Information of n before any reading, shape (K, K).
    slot
        Which readings share noise: their blocks of V, shape (N,).
    """

    points: FloatArray
    residual: FloatArray
    whitening: csr_array
    nuisance: csr_array
    prior: FloatArray
    slot: IntArray

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def _root(self) -> tuple[FloatArray, FloatArray]:
        """Cholesky factor of the scaled information of n, and the scale."""
        information = self.prior + (self.nuisance.T @ self.nuisance).toarray()
        scale = 1 / np.sqrt(np.diag(information))
        lower = cholesky(information * scale * scale[:, None], lower=True, check_finite=False)
        return lower, scale

    def projected(self, white: FloatArray) -> FloatArray:
        """Return ``L^-1 X^T V^T`` times white columns, shape (3 N, M): (K, M)."""
        lower, scale = self._root
        seen = scale[:, None] * (self.nuisance.T @ white)
        return np.asarray(solve_triangular(lower, seen, lower=True, check_finite=False))

    def whitened(self, features: FloatArray) -> FloatArray:
        """Return V times fields of M columns, shape (N, 3, M): (3 N, M)."""
        return np.asarray(self.whitening @ features.reshape(3 * len(self), -1))

    def information(self, features: FloatArray) -> FloatArray:
        """Return the information of the amplitudes of fields, shape (N, 3, M): (M, M)."""
        white = self.whitened(features)
        seen = self.projected(white)
        return np.asarray(white.T @ white - seen.T @ seen)

    def pull(self, residual: FloatArray) -> tuple[FloatArray, float]:
        """Return the precision times residuals in uT, shape (N, 3), and their squared length."""
        lower, scale = self._root
        white = self.whitened(residual)
        seen = self.projected(white)
        back = scale[:, None] * solve_triangular(
            lower, seen, lower=True, trans="T", check_finite=False
        )
        left = white - self.nuisance @ back
        pulled = (self.whitening.T @ left).reshape(-1, 3)
        return np.asarray(pulled), float(white.ravel() @ left.ravel())

    def without(self, readings: Sequence[int]) -> "MarginalRows":
        """Return the same where some readings may be wrong by anything: they say nothing more."""
        if not len(readings):
            return self
        columns = (AXES * np.array(readings, dtype=int)[:, None] + np.arange(AXES)).ravel()
        own = csr_array(self.whitening[:, columns])
        return replace(
            self,
            nuisance=hstack([self.nuisance, own], format="csr"),
            prior=block_diag(self.prior, ANYTHING_UT**-2 * np.eye(len(columns))),
        )

    def beside(self, features: FloatArray, sigma: float) -> "MarginalRows":
        """Return the same beside fields of any strength.

        Parameters
        ----------
        features
            M of them, per unit, shape (N, 3, M).
        sigma
            Standard deviation of each one's strength before readings.
        """
        return replace(
            self,
            nuisance=hstack([self.nuisance, csr_array(self.whitened(features))], format="csr"),
            prior=block_diag(self.prior, sigma**-2 * np.eye(features.shape[2])),
        )

    def near(self, keep: BoolArray) -> "MarginalRows":
        """Return the readings of all slots of which some are to be kept, (N,), as views.

        What the others know of the errors counts as before.
        """
        chosen = np.isin(self.slot, np.unique(self.slot[keep]))
        at = np.flatnonzero(chosen)
        rows = (3 * at[:, None] + np.arange(3)).ravel()
        part = replace(
            self,
            points=self.points[at],
            residual=self.residual[at],
            whitening=self.whitening[rows][:, rows],
            nuisance=self.nuisance[rows],
            slot=self.slot[at],
        )
        part.__dict__["_root"] = self._root
        return part
