"""The noise of readings: what map and sensor contribute, how large it is, and what a fit leaves."""

import numpy as np
from numba import njit
from scipy.optimize import brentq

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.calibration import ResidualFigures

# Search range for a sensor's noise in uT: from below the resolution of any vehicle's magnetometer
# to above the Earth's field.
NOISE_RANGE = (1e-4, 1e3)
LEAST_LEFT = 0.5  # of a residual's variance by a fit
CHANCE_SIGMAS = 4.0  # of a correlation of N values, which by chance is 1 / sqrt(N)
HALF = 0.5  # a reading of no more weight has no part in the estimate of the noise


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def is_chance(correlation: float, values: int) -> bool:
    """Return whether a correlation of so many values is no more than chance makes it."""
    return bool(correlation < CHANCE_SIGMAS / np.sqrt(values))


def map_covariance(C: FloatArray, R_map_lidar: FloatArray, map_variance: FloatArray) -> FloatArray:
    """Return ``C R^T V R C^T``: the map's uncertainty as a sensor sees it, uT^2, (N, 3, 3).

    Parameters
    ----------
    C
        Distortion matrix of the sensor that made each reading, shape (N, 3, 3).
    R_map_lidar
        Rotations from lidar to map, shape (N, 3, 3).
    map_variance
        Variance of the map per axis of the map frame in uT^2, shape (N, 3).
    """
    share = np.empty(C.shape)
    C, R, variance = (np.ascontiguousarray(each) for each in (C, R_map_lidar, map_variance))
    write_map_shares(C, R, variance, share)
    return share


@njit(cache=True, nogil=True)
def write_map_shares(C: FloatArray, R: FloatArray, variance: FloatArray, share: FloatArray) -> None:
    """Write what ``map_covariance`` returns: products of small matrices, one after the other."""
    A = np.empty((3, 3))
    for n in range(len(share)):
        for i in range(3):
            for k in range(3):
                A[i, k] = (
                    C[n, i, 0] * R[n, k, 0] + C[n, i, 1] * R[n, k, 1] + C[n, i, 2] * R[n, k, 2]
                )
        v0, v1, v2 = variance[n, 0], variance[n, 1], variance[n, 2]
        for i in range(3):
            for j in range(i + 1):
                both = A[i, 0] * v0 * A[j, 0] + A[i, 1] * v1 * A[j, 1] + A[i, 2] * v2 * A[j, 2]
                share[n, i, j] = share[n, j, i] = both


def reading_covariance(
    noise: FloatArray, map_share: FloatArray, trust: FloatArray | float = 1.0
) -> FloatArray:
    """Return ``(sigma^2 I + map_share) / trust``, of each residual in uT^2, (N, 3, 3).

    Parameters
    ----------
    noise
        Standard deviation of the sensor that made the reading in uT, shape (N,).
    map_share
        What the map contributes, shape (N, 3, 3).
    trust
        How far each reading counts, shape (N,).
    """
    covariance = (noise**2)[:, None, None] * np.eye(3) + map_share
    return np.asarray(covariance / np.reshape(trust, (-1, 1, 1)))


def whitening(covariance: FloatArray) -> FloatArray:
    """Return lower triangular matrices W with ``W S W^T = I``, shape (N, 3, 3).

    Raises
    ------
    LinAlgError
        If a covariance is not positive definite.
    """
    # W = L^-1 for S = L L^T; the upper triangle stays zero.
    W = np.zeros(covariance.shape)
    if not write_inverse_roots(np.ascontiguousarray(covariance, dtype=np.float64), W):
        raise np.linalg.LinAlgError("a reading's covariance is not positive definite")
    return W


@njit(cache=True, nogil=True)
def write_inverse_roots(covariance: FloatArray, W: FloatArray) -> bool:
    """Write the inverse Cholesky factors of matrices (N, 3, 3) into zeros; whether all exist.

    In closed form: LAPACK takes ten times as long to be called for each.
    """
    for n in range(len(covariance)):
        S, w = covariance[n], W[n]
        if not S[0, 0] > 0:
            return False
        w[0, 0] = 1 / np.sqrt(S[0, 0])
        l10, l20 = S[1, 0] * w[0, 0], S[2, 0] * w[0, 0]
        d1 = S[1, 1] - l10 * l10
        if not d1 > 0:
            return False
        w[1, 1] = 1 / np.sqrt(d1)
        l21 = (S[2, 1] - l20 * l10) * w[1, 1]
        d2 = S[2, 2] - l20 * l20 - l21 * l21
        if not d2 > 0:
            return False
        w[2, 2] = 1 / np.sqrt(d2)
        w[1, 0] = -l10 * w[0, 0] * w[1, 1]
        w[2, 1] = -l21 * w[1, 1] * w[2, 2]
        w[2, 0] = -(l20 * w[0, 0] + l21 * w[1, 0]) * w[2, 2]
    return True


def estimate_noise(
    residual: FloatArray, map_variance: FloatArray, left: FloatArray | float
) -> float:
    """Return the most likely standard deviation of a sensor's noise in uT.

    The residuals are modelled as independent normal numbers of variance
    ``sigma^2 + map_variance``; what the map's variance already explains is not counted again.
    A fit leaves less than that of them (restricted maximum likelihood, Patterson and Thompson
    1971, where all variances are equal).

    Parameters
    ----------
    residual
        Residuals in uT, shape (N, 3).
    map_variance
        Mean variance of the map's prediction in uT^2, shape (N,).
    left
        Share of each residual's variance that the fit leaves, shape (N,), or of all of them. No
        less than half is counted.
    """
    # Bessel: what is fitted to a reading is missing in its residual.
    e2 = residual**2 / np.reshape(np.maximum(left, LEAST_LEFT), (-1, 1))
    v = map_variance[:, None]

    # Derivative of -2 log likelihood by sigma^2; over log sigma, as the range spans seven decades.
    def score(log_sigma: float) -> float:
        total = np.exp(2 * log_sigma) + v
        return float(np.sum(1 / total - e2 / total**2))

    low, high = np.log(NOISE_RANGE)
    if score(low) >= 0:
        return NOISE_RANGE[0]
    if score(high) <= 0:
        return NOISE_RANGE[1]
    return float(np.exp(brentq(score, low, high, xtol=1e-6)))


def residual_figures(residual: FloatArray, white: FloatArray, taken: float) -> ResidualFigures:
    """Summarise the residuals of one sensor.

    Parameters
    ----------
    residual
        ``C b + H - z`` in uT, shape (N, 3).
    white
        What is left of them once errors that readings share are taken out, in units of its standard
        deviation, shape (N, 3): of these is the chi-square.
    taken
        Degrees of freedom that the fit took; see ``estimate_noise``.
    """
    norm = np.linalg.norm(residual, axis=1)
    freedom = max(residual.size - taken, 1)
    return ResidualFigures(
        readings=len(residual),
        rms_axes=np.sqrt(np.mean(residual**2, axis=0)),
        rms=rms(norm),
        median_norm=float(np.median(norm)),
        p95_norm=float(np.quantile(norm, 0.95)),
        max_norm=float(norm.max()),
        chi2_per_dof=float(np.sum(white**2) / freedom),
    )
