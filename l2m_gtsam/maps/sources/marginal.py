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
from scipy.sparse import csr_array

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.solve.linear_algebra import RowBlocks

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
        V X, of 3 N rows and K columns.
    prior
        Information of n before any reading, shape (K, K).
    slot
        Which readings share noise: their blocks of V, shape (N,).
    """

    points: FloatArray
    residual: FloatArray
    whitening: csr_array
    nuisance: RowBlocks
    prior: FloatArray
    slot: IntArray

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def _root(self) -> tuple[FloatArray, FloatArray]:
        """Cholesky factor of the scaled information of n, and the scale."""
        information = self.prior + self.nuisance.gram()
        scale = 1 / np.sqrt(np.diag(information))
        lower = cholesky(information * scale * scale[:, None], lower=True, check_finite=False)
        return lower, scale

    def projected(self, white: csr_array | FloatArray) -> FloatArray:
        """Return ``L^-1 X^T V^T`` times white columns, shape (3 N, M): (K, M)."""
        lower, scale = self._root
        seen = scale[:, None] * self.nuisance.transposed_times(white)
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
        return self._grown(csr_array(self.whitening[:, columns]), ANYTHING_UT)

    def beside(self, features: FloatArray, sigma: float) -> "MarginalRows":
        """Return the same beside fields of any strength.

        Parameters
        ----------
        features
            M of them, per unit, shape (N, 3, M).
        sigma
            Standard deviation of each one's strength before readings.
        """
        return self._grown(self.whitened(features), sigma)

    def _grown(self, white: csr_array | FloatArray, sigma: float) -> "MarginalRows":
        """Return the same with M more errors, white columns, shape (3 N, M), of this deviation."""
        count = white.shape[1]
        prior = sigma**-2 * np.eye(count)
        grown = replace(
            self, nuisance=self.nuisance.beside(white), prior=block_diag(self.prior, prior)
        )
        # A root of the larger information is the one of before with rows below it.
        (lower, scale), own = self._root, np.asarray(prior + white.T @ white)
        units = 1 / np.sqrt(np.diag(own))
        below = self.projected(white) * units
        left = own * units * units[:, None] - below.T @ below
        corner = cholesky(left, lower=True, check_finite=False)
        whole = np.block([[lower, np.zeros((len(lower), count))], [below.T, corner]])
        grown.__dict__["_root"] = whole, np.concatenate([scale, units])
        return grown

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
            nuisance=self.nuisance.at(rows),
            slot=self.slot[at],
        )
        part.__dict__["_root"] = self._root
        return part
