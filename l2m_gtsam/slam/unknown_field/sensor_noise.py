"""What a sensor's readings are off by on a drive: white noise, and an error that lasts.

What lasts is detail of the field that no wave holds. It changes as the vehicle moves, however long
that takes: readings of two model ships and two sensors in the hand are likelier by exp(63) to
exp(357) with errors that last over a path than with such that last over a time.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numba import njit
from scipy.linalg import cholesky_banded

from l2m_factors import N, SlowError, slow_bridge, slow_error_graph
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.solve.linear_algebra import covariance_root

AXES = 3
LEAST_WHITE = 0.09  # of the variance: what interpolation between key poses leaves is as large
LEAST_M = 1e-6  # between two readings


@dataclass(frozen=True)
class SensorNoise:
    """Errors of readings along each axis of the sensor.

    Attributes
    ----------
    ut
        Standard deviation in uT.
    white
        Share of its variance that is independent from reading to reading.
    slow_m
        Path in metres over which the rest changes: its correlation falls by e.
    """

    ut: float
    white: float
    slow_m: float

    @property
    def white_ut(self) -> float:
        """Standard deviation of the independent part in uT."""
        return float(self.ut * np.sqrt(self.white))

    @property
    def slow_ut(self) -> float:
        """Standard deviation of the other part in uT."""
        return float(self.ut * np.sqrt(1 - self.white))

    def as_white(self, apart_m: float) -> float:
        """Return the size in uT of white noise that leaves as much in the mean of many readings.

        These are so far apart; with a the correlation of the slow error between two, its variance
        counts ``(1 + a) / (1 - a)`` times.
        """
        alike = np.exp(-max(apart_m, LEAST_M) / self.slow_m)
        return float(np.hypot(self.white_ut, self.slow_ut * np.sqrt((1 + alike) / (1 - alike))))

    def floored(self) -> "SensorNoise":
        """Return noise that is white enough for interpolated readings."""
        return replace(self, white=max(self.white, LEAST_WHITE))

    def scaled(self, factor: float) -> "SensorNoise":
        """Return noise that is so many times as large."""
        return replace(self, ut=factor * self.ut)


def whiten(noise: SensorNoise, path_m: FloatArray, rows: FloatArray) -> float:
    """Multiply rows by the inverse of the Cholesky factor of N readings' noise along one axis.

    The rows become the innovations of a Kalman filter that follows the slow error: in linear time.

    Parameters
    ----------
    noise
        Of the sensor.
    path_m
        Path to the readings in metres in ascending order, shape (N,).
    rows
        Shape (N, q) in C order, changed in place.

    Returns
    -------
    float
        Logarithm of the factor's determinant.
    """
    slow, white = noise.slow_ut**2, noise.white_ut**2
    return float(write_innovations(np.exp(-np.diff(path_m) / noise.slow_m), slow, white, rows))


@njit(cache=True, nogil=True, error_model="numpy")
def write_innovations(decay: FloatArray, slow: float, white: float, rows: FloatArray) -> float:
    """Write innovations over rows (N, q), for the decay of the slow error between these, (N - 1,).

    ``slow`` and ``white`` are variances; see ``whiten``.
    """
    expected, variance, volume = np.zeros(rows.shape[1]), slow, 0.0
    for n in range(len(rows)):
        if n:
            left = decay[n - 1]
            variance = left * left * variance + (1 - left * left) * slow
            expected *= left
        total = variance + white
        gain, scale = variance / total, 1 / np.sqrt(total)
        volume += 0.5 * np.log(total)
        for c in range(rows.shape[1]):
            off = rows[n, c] - expected[c]
            expected[c] += gain * off
            rows[n, c] = scale * off
        variance -= gain * variance
    return volume


class SlowErrors:
    """Slow errors of the readings of a drive with one sensor, as factors.

    Parameters
    ----------
    noise
        Of the sensor.
    key_poses_m, readings_m
        Path to K key poses and N readings in metres, in ascending order, shapes (K,) and (N,).
    """

    def __init__(self, noise: SensorNoise, key_poses_m: FloatArray, readings_m: FloatArray) -> None:
        self._noise, self._key_poses, self._readings = noise, key_poses_m, readings_m

    @property
    def white(self) -> float:
        """Standard deviation of white noise in units of all noise."""
        return float(np.sqrt(self._noise.white))

    def of(self, key_pose: int, rows: IntArray) -> tuple[SlowError, FloatArray]:
        """Return what readings on a key pose have of the errors at it and at the next.

        With it what remains, in one standard deviation of each independent error, uT, (n, 3, q).
        """
        begin, end = self._key_poses[key_pose : key_pose + 2]
        at = np.clip(self._readings[rows], begin, end)
        bridge, ut = slow_bridge(at - begin, end - at, self._noise.slow_m), self._noise.slow_ut
        left = np.einsum("ij,nm->nimj", ut * np.eye(AXES), covariance_root(bridge.covariance))
        return SlowError(key_pose, ut * bridge.shares), left.reshape(len(rows), AXES, -1)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return their prior."""
        return slow_error_graph(self._key_poses, self._noise.slow_m)

    def values(self) -> gtsam.Values:
        """Return initial values."""
        values = gtsam.Values()
        for k in range(len(self._key_poses)):
            values.insert(N(k), np.zeros(AXES))
        return values


class WhiteInformation:
    """The inverse of the covariance of N readings' independent noise along one axis.

    Parameters
    ----------
    variance
        Of each in uT^2, shape (N,).
    """

    def __init__(self, variance: FloatArray) -> None:
        self._known = 1 / variance

    def __call__(self, rows: FloatArray) -> FloatArray:
        """Return the inverse times rows, shape (N, q)."""
        return np.asarray(self._known[:, None] * rows)


class NoiseInformation:
    """The inverse of the covariance of N readings' noise along one axis, in linear time.

    With V the diagonal of the white part and Q the tridiagonal inverse of the other part's
    covariance it is ``V^-1 - V^-1 (Q + V^-1)^-1 V^-1``.

    Parameters
    ----------
    noise
        Of the sensor; it is not all white.
    path_m
        Path to the readings in metres in ascending order, shape (N,).
    weights
        By which the white part's variance is divided for each, shape (N,).
    """

    def __init__(self, noise: SensorNoise, path_m: FloatArray, weights: FloatArray) -> None:
        self._white = weights / noise.white_ut**2
        a = np.exp(-np.maximum(np.diff(path_m), LEAST_M) / noise.slow_m)
        known = 1 / (noise.slow_ut**2 * (1 - a**2))
        band = np.zeros((2, len(path_m)))  # lower form: the diagonal, and what is below it
        band[0] = self._white
        band[0, 0] += 1 / noise.slow_ut**2
        band[0, :-1] += a**2 * known
        band[0, 1:] += known
        band[1, :-1] = -a * known
        self._lower = cholesky_banded(band, lower=True)

    def __call__(self, rows: FloatArray) -> FloatArray:
        """Return the inverse times rows, shape (N, q)."""
        slow = self._white[:, None] * rows
        solve_tridiagonal(self._lower, slow)
        return np.asarray(self._white[:, None] * (rows - slow))


@njit(cache=True, nogil=True, error_model="numpy")
def solve_tridiagonal(lower: FloatArray, rows: FloatArray) -> None:
    """Write the solution over rows (N, q), for a Cholesky factor in its lower banded form, (2, N).

    Row by row: LAPACK's takes a column after the other.
    """
    diagonal, below = lower
    for n in range(len(rows)):
        for c in range(rows.shape[1]):
            before = below[n - 1] * rows[n - 1, c] if n else 0.0
            rows[n, c] = (rows[n, c] - before) / diagonal[n]
    for n in range(len(rows) - 1, -1, -1):
        for c in range(rows.shape[1]):
            after = below[n] * rows[n + 1, c] if n + 1 < len(rows) else 0.0
            rows[n, c] = (rows[n, c] - after) / diagonal[n]
