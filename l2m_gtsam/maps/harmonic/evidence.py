r"""The posterior of a tile's weights and the marginal likelihood of its readings.

With features F, prior variances S and noise variances sigma^2 / w per row, and whitened by the
prior, everything follows from one Cholesky factor of

.. math::
    A = I + S^{1/2} F^T W F S^{1/2} / \sigma^2 = K K^T .

``F^T W F`` is accumulated once; one likelihood with all its derivatives then costs m^3,
whatever the number of readings.

A part of the noise may be shared: errors of the poses that last. With E what independent errors do
to the readings, the noise has the covariance

.. math::
    N = \sigma^2 W^{-1} + E E^T, \qquad
    \sigma^2 N^{-1} = W - U^T U, \quad U = K_E^{-1} E^T W / \sigma, \quad
    K_E K_E^T = 1 + E^T W E / \sigma^2

In the sums such errors are weights like others, which are integrated out.
"""

import operator
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dlauum, dtrtri

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.triangular import TriangularFactor
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.solve.linear_algebra import submatrix

ROUNDING, LOST = 1e-14, 1e-11


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
        """K_E, lower triangular, shape (q, q)."""
        weighted = (self.errors * self.weight[:, None, None]).reshape(-1, self.errors.shape[2])
        inner = self.errors.reshape(weighted.shape).T @ weighted / self.noise**2
        inner[np.diag_indices_from(inner)] += 1.0
        return np.asarray(cholesky(inner, lower=True, check_finite=False))

    def given(self, values: FloatArray) -> FloatArray:
        """Return ``sigma^2 N^-1 X`` for X, both of shape (n, 3, k)."""
        weighted = values * self.weight[:, None, None]
        E = self.errors.reshape(-1, self.errors.shape[2])
        crossed = E.T @ weighted.reshape(len(E), -1) / self.noise**2
        shared = (E @ cho_solve((self.root, True), crossed, check_finite=False)).reshape(
            values.shape
        )
        return np.asarray(weighted - shared * self.weight[:, None, None])


@dataclass(frozen=True)
class Normal:
    """Sums over the readings of a tile that the posterior is made of.

    Attributes
    ----------
    FF
        ``F^T W F``, shape (m, m).
    Fy
        ``F^T W y``, shape (m,).
    yy
        ``y^T W y`` in uT^2.
    rows
        Number of values: three per reading.
    log_weight
        Sum of the logarithms of all rows' weights.
    """

    FF: FloatArray
    Fy: FloatArray
    yy: float
    rows: int
    log_weight: float

    def __add__(self, other: "Normal") -> "Normal":
        return self._with(other, operator.add)

    def __sub__(self, other: "Normal") -> "Normal":
        return self._with(other, operator.sub)

    def _with(self, other: "Normal", combined: Callable[[Any, Any], Any]) -> "Normal":
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Normal(*(combined(*pair) for pair in pairs))


def normal_of(basis: Basis, readings: TrainingSet, shared: SharedNoise | None = None) -> Normal:
    """Return the sums over readings, batch by batch.

    What they share of their noise is taken out: the sums are then those for its noise alone.
    """
    m, q = len(basis), 0 if shared is None else shared.errors.shape[2]
    FF, Fy, yy = np.zeros((m + q, m + q)), np.zeros(m + q), 0.0
    for at in batches(len(readings)):
        root = np.sqrt(readings.weight[at])
        F = basis.features(readings.points[at])
        if shared is not None:  # errors are weights, too, of unit variance
            F = np.concatenate([F, shared.errors[at]], axis=2)
        F *= root[:, None, None]
        F = F.reshape(-1, m + q)
        y = (readings.field[at] * root[:, None]).ravel()
        FF += F.T @ F
        Fy += F.T @ y
        yy += float(y @ y)
    log_weight = 3 * float(np.log(readings.weight).sum())
    whole = Normal(FF, Fy, yy, 3 * len(readings), log_weight)
    if shared is None:
        return whole
    return marginalised(whole, np.arange(m), np.zeros(m + q), shared.noise)


def marginalised(normal: Normal, kept: IntArray, log_variance: FloatArray, noise: float) -> Normal:
    """Return the sums for some weights alone, the others integrated out under their prior.

    Evidence of the kept weights' prior is the same.

    Parameters
    ----------
    normal
        Sums over the readings, for m weights; ``Fy`` may have columns, shape (m,) or (m, c), of
        which ``yy`` is that of the first.
    kept
        Columns of the weights that stay, shape (k,).
    log_variance, noise
        Prior of all weights, shape (m,), and noise in uT.
    """
    others = np.ones(len(normal.Fy), dtype=np.bool_)
    others[kept] = False
    gone = np.flatnonzero(others)
    D = np.exp(0.5 * log_variance[gone])
    part = replace(normal, FF=submatrix(normal.FF, gone))
    K = whitened_factor(part, D, noise)
    columns, k = normal.Fy.reshape(len(others), -1), len(kept)
    right = np.empty((len(gone), k + columns.shape[1]), order="F")
    right[:, :k], right[:, k:] = normal.FF[np.ix_(kept, gone)].T, columns[gone]
    right *= (D / noise)[:, None]
    half = solve_triangular(K, right, lower=True, overwrite_b=True, check_finite=False)
    # Schur complement of the block that is integrated out.
    known = half.T @ half
    return Normal(
        submatrix(normal.FF, kept) - known[:k, :k],
        normal.Fy[kept] - known[:k, k:].reshape(k, *normal.Fy.shape[1:]),
        normal.yy - float(known[k, k]),
        normal.rows,
        normal.log_weight - 2 * float(np.log(np.diag(K)).sum()),
    )


@dataclass(frozen=True)
class Weights:
    """Posterior of a tile's weights: mean, and covariance ``L L^T`` with ``L = D K^-T``.

    Attributes
    ----------
    mean
        Posterior mean, shape (m,).
    prior_sigma
        Diagonal of D: prior standard deviations, shape (m,).
    factor
        Cholesky factor K, lower triangular, (m, m).
    """

    mean: FloatArray
    prior_sigma: FloatArray
    factor: TriangularFactor

    def root(self, features: FloatArray) -> FloatArray:
        """Return ``F L`` for features F, both of shape (J, m)."""
        # L = D K^-T, hence the rows of (F L)^T are K^-1 D F^T: one triangular solve.
        white = np.multiply(features.T, self.prior_sigma[:, None], order="C")
        self.factor.solve_rows(white)
        return np.asarray(white.T)

    def root_rows(self, basis: Basis, points: FloatArray) -> FloatArray:
        """Return ``F L`` at points (N, 3), uT, but weight by weight, shape (m, 3, N)."""
        rows = basis.rows(points, self.prior_sigma)
        self.factor.solve_rows(rows.reshape(len(rows), 3 * len(points)))
        return rows

    def unwhitened(self, directions: FloatArray) -> FloatArray:
        """Return ``L U`` for directions U, both of shape (m, r)."""
        turned = np.array(directions, order="C")
        self.factor.solve_transposed(turned)
        turned *= self.prior_sigma[:, None]
        return turned


def condition(normal: Normal, log_variance: FloatArray, noise: float) -> Weights:
    """Return the posterior of the weights for a prior and a noise in uT."""
    D = np.exp(0.5 * log_variance)
    K = whitened_factor(normal, D, noise)
    # With w = D v the posterior mean of v solves (I + D F^T F D / s^2) v = D F^T y / s^2: well
    # conditioned whatever the range of the prior variances.
    u = D * normal.Fy / noise**2
    mean = D * cho_solve((K, True), u, check_finite=False)
    return Weights(mean, D, TriangularFactor.of(K))


def whitened_factor(normal: Normal, D: FloatArray, noise: float) -> FloatArray:
    """Return the Cholesky factor of ``I + D F^T W F D / sigma^2``, shape (m, m)."""
    # One is lost to rounding where the readings know a weight 1e16 times better than the prior.
    A = whitened(normal, D, noise)
    try:
        return np.asarray(cholesky(A, lower=True, overwrite_a=True, check_finite=False))
    except LinAlgError:  # what was integrated out before left rounding of the largest entries
        A = whitened(normal, D, noise)
        A[np.diag_indices_from(A)] += LOST * A.diagonal().max()
        return np.asarray(cholesky(A, lower=True, overwrite_a=True, check_finite=False))


def whitened(normal: Normal, D: FloatArray, noise: float) -> FloatArray:
    """Return ``I + D F^T W F D / sigma^2``, (m, m), in LAPACK's order.

    Its diagonal has a share more, for rounding.
    """
    scale = D / noise
    A = normal.FF * scale[:, None]
    A *= scale
    A[np.diag_indices_from(A)] += 1.0 + ROUNDING * A.diagonal()
    return np.asarray(A.T)  # it is symmetric: columns one after the other, without a copy


def inverse_factor_of(factor: FloatArray) -> FloatArray:
    """Return the inverse of a lower triangular matrix, zeros above the diagonal, (m, m)."""
    inverse, _ = dtrtri(factor, lower=1)
    return np.asarray(inverse)


def unknown_share(inverse_factor: FloatArray) -> FloatArray:
    """Return the share of each weight's prior variance that is left, the diagonal of A^-1, (m,)."""
    return np.asarray(np.einsum("ij,ij->j", inverse_factor, inverse_factor))


@dataclass(frozen=True)
class Evidence:
    """Logarithm of the marginal likelihood.

    Attributes
    ----------
    value
        Log marginal likelihood in nats.
    factor
        K, lower triangular, shape (m, m).
    mean
        Posterior mean of the whitened weights, shape (m,).
    misfit
        ``|y - F w|^2 / sigma^2`` at the posterior mean.
    rows
        Number of values: three per reading.
    """

    value: float
    factor: FloatArray
    mean: FloatArray
    misfit: float
    rows: int

    def slopes(self) -> "EvidenceSlopes":
        """Return the derivatives, which cost as much as the value."""
        inverse_factor = inverse_factor_of(self.factor)
        known = 1 - unknown_share(inverse_factor)
        return EvidenceSlopes(
            by_log_variance=0.5 * (self.mean**2 - known),
            by_log_noise=self.misfit + float(known.sum()) - self.rows,
            inverse_factor=inverse_factor,
        )


@dataclass(frozen=True)
class EvidenceSlopes:
    """Derivatives of the logarithm of the marginal likelihood.

    Attributes
    ----------
    by_log_variance
        By the logarithm of each weight's prior variance, shape (m,).
    by_log_noise
        By the logarithm of the noise.
    inverse_factor
        ``K^-1``, lower triangular, shape (m, m).
    """

    by_log_variance: FloatArray
    by_log_noise: float
    inverse_factor: FloatArray

    def information(self, slopes: FloatArray) -> FloatArray:
        """Return the expected information on numbers that the prior depends on, shape (p, p).

        Parameters
        ----------
        slopes
            Derivatives of the logarithms of the prior variances by these numbers, shape (p, m).
        """
        # Fisher information tr(P S_i P S_j) / 2 of a Gaussian's covariance: for the log variances
        # of two weights it is half the square of an entry of I - A^-1, of which the lower triangle
        # is computed: what is left of the prior's covariance, whitened.
        unknown, _ = dlauum(self.inverse_factor, lower=1)
        known = -np.asarray(unknown)
        known[np.diag_indices_from(known)] += 1.0
        known *= known
        half = slopes @ known @ slopes.T
        return np.asarray(0.5 * (half + half.T - slopes * np.diag(known) @ slopes.T))


def evidence(normal: Normal, log_variance: FloatArray, noise: float) -> Evidence:
    """Return how likely the readings are under a prior and a noise in uT."""
    D = np.exp(0.5 * log_variance)
    K = whitened_factor(normal, D, noise)
    u = D * normal.Fy / noise**2
    v = cho_solve((K, True), u, check_finite=False)
    # Inverse and determinant of the readings' covariance by the lemmas of Woodbury and Sylvester
    # (Rasmussen and Williams 2006, A.9 and A.10): m x m instead of 3N x 3N.
    log_det = 2 * float(np.log(np.diag(K)).sum())
    chi2 = normal.yy / noise**2 - float(u @ v)
    log_noise = normal.rows * np.log(2 * np.pi * noise**2) - normal.log_weight
    # By w^T (A - I) w = w^T u - w^T w for whitened weights.
    misfit = chi2 - float(v @ v)
    return Evidence(-0.5 * (chi2 + log_det + log_noise), K, v, misfit, normal.rows)
