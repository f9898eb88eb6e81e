r"""How likely readings are for given sensors, whatever the field: its waves are integrated out.

With the sensors' undistorted readings y in the map frame, features F at the sensors' places, prior
variances S of the waves and noise sigma,

.. math::
    \log L = \log N(y; 0, \sigma^2 I + F S F^T) - \sum_k \log |\det C_k|

The last term is the price of a distortion that makes all fields small.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.evidence import Evidence, evidence, normal_of
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.training import TrainingSet

SIZE = 16  # t, C row by row, H, time offset
T, C, H, TAU = slice(0, 3), slice(3, 12), slice(12, 15), 15
STEP_M = 1e-4  # of a central difference: features bend over centimetres


@dataclass(frozen=True)
class SuiteWindow:
    """Readings of a part of a survey, and the waves that describe the field there.

    Attributes
    ----------
    basis
        Waves.
    middle
        Mean of the readings' positions when the basis was made, in metres, shape (3,). The basis
        moves with it: its prior depends on heights, and must not determine the sensors' heights.
    readings
        As sensors read them, with the motion of the lidar, N in number.
    """

    basis: Basis
    middle: FloatArray
    readings: Readings


@dataclass(frozen=True)
class SuiteLikelihood:
    """A log likelihood, its slope and the expected information about the S sensors.

    Attributes
    ----------
    value
        In nats.
    slope
        By (t, C row by row, H, time offset) of each sensor, shape (16 S,).
    information
        Shape (16 S, 16 S).
    residuals
        Of each window what the most likely field leaves of its readings, uT, shape (N, 3).
    """

    value: float
    slope: FloatArray
    information: FloatArray
    residuals: tuple[FloatArray, ...]

    def __add__(self, other: "SuiteLikelihood") -> "SuiteLikelihood":
        return SuiteLikelihood(
            self.value + other.value,
            self.slope + other.slope,
            self.information + other.information,
            self.residuals + other.residuals,
        )


@dataclass(frozen=True)
class Undistorted:
    """Readings with their distortion undone.

    Attributes
    ----------
    points
        Where they were taken in the map in metres, shape (N, 3).
    b
        Field in the lidar frame in uT, shape (N, 3).
    field
        In the map frame, shape (N, 3).
    turned
        From the sensor's axes to the map's, ``R C^-1``, shape (N, 3, 3).
    lever
        From the lidar to the sensor in its frame in metres, shape (N, 3).
    """

    points: FloatArray
    b: FloatArray
    field: FloatArray
    turned: FloatArray
    lever: FloatArray


def undistorted(readings: Readings, sensors: FloatArray) -> Undistorted:
    """Return what sensors with these parameters, shape (S, 16), read; poses are as they are."""
    R = readings.R_map_lidar
    inverse = np.linalg.inv(sensors[:, C].reshape(-1, 3, 3))[readings.sensor]
    b = np.einsum("nij,nj->ni", inverse, readings.field - sensors[readings.sensor, H])
    lever = sensors[readings.sensor, T]
    points = np.einsum("nij,nj->ni", R, lever) + readings.p_map_lidar
    field = np.einsum("nij,nj->ni", R, b)
    return Undistorted(points, b, field, R @ inverse, lever)


def suite_likelihood(
    window: SuiteWindow, sensors: FloatArray, prior: Hyperparameters
) -> SuiteLikelihood:
    """Return how likely a window's readings are.

    Parameters
    ----------
    window
        The window; poses of the readings are those at the sensors' clocks.
    sensors
        Parameters of S sensors, shape (S, 16).
    prior
        Of the field, and the noise.
    """
    return likelihood_at(window, window_slopes(window, sensors, prior), sensors)


def likelihood_at(window: SuiteWindow, at: "WindowSlopes", sensors: FloatArray) -> SuiteLikelihood:
    """Return the same from slopes for these sensors that are known already."""
    r, J = at.residual, at.slopes
    slope = -np.einsum("ni,nij->j", r, J) / at.noise**2
    slope -= np.einsum("ni,nij->j", at.complexity(), at.places)
    turned, volume = _volume_change(window.readings, sensors)
    value = at.field.value - volume
    return SuiteLikelihood(value, slope - turned, at.information(J), (r,))


@dataclass(frozen=True)
class WindowSlopes:
    """A window's readings beside its most likely field, and how they hang on the sensors.

    Attributes
    ----------
    basis
        Of the window, m weights.
    noise
        Of a reading in uT.
    undone
        Readings with their distortion undone.
    points
        Where they count as taken, shape (N, 3).
    field, scale
        Posterior of the weights, each in units of its prior's standard deviation, shape (m,).
    residual
        Undistorted readings less the most likely field, uT, shape (N, 3).
    gradient
        Of that field in uT/m, shape (N, 3, 3).
    places, slopes
        Derivatives of places and residuals by the sensors' parameters, shapes (N, 3, 16 S).
    """

    basis: Basis
    noise: float
    undone: Undistorted
    points: FloatArray
    field: Evidence
    scale: FloatArray
    residual: FloatArray
    gradient: FloatArray
    places: FloatArray
    slopes: FloatArray

    def information(self, columns: FloatArray) -> FloatArray:
        """Return ``A^T (sigma^2 I + F S F^T)^-1 A`` for A in uT, shape (N, 3, k): (k, k)."""
        D, k = self.scale, columns.shape[2]
        own, shared = np.zeros((k, k)), np.zeros((len(D), k))
        for at in batches(len(self.points)):
            flat = columns[at].reshape(-1, k)
            own += flat.T @ flat
            shared += self.basis.features(self.points[at]).reshape(-1, len(D)).T @ flat
        known = solve_triangular(self.field.factor, D[:, None] * shared / self.noise, lower=True)
        return np.asarray((own - known.T @ known) / self.noise**2)

    def complexity(self) -> FloatArray:
        """Return derivatives of half the log determinant by the readings' places, shape (N, 3).

        ``d log det(sigma^2 I + F S F^T) / 2 = tr(Sigma F^T dF) / sigma^2`` with the weights'
        posterior covariance Sigma.
        """
        features, points, K, D = self.basis.features, self.points, self.field.factor, self.scale
        slopes = np.empty_like(points)
        for at in batches(len(points)):
            F = features(points[at])
            n, _, m = F.shape
            half = solve_triangular(K, (F.reshape(-1, m) * D).T, lower=True)
            spread = (solve_triangular(K, half, trans=1, lower=True).T * D).reshape(n, 3, m)
            for axis, step in enumerate(STEP_M * np.eye(3)):
                dF = features(points[at] + step) - features(points[at] - step)
                change = np.einsum("nim,nim->n", spread, dF)
                slopes[at, axis] = change / (2 * STEP_M * self.noise**2)
        return slopes

    def beside_field(self, values: FloatArray) -> FloatArray:
        """Return what no field explains of values in uT, shape (N, 3)."""
        shared = np.zeros(len(self.scale))
        for at in batches(len(values)):
            F = self.basis.features(self.points[at])
            shared += np.einsum("nim,ni->m", F, values[at])
        weights = cho_solve((self.field.factor, True), self.scale * shared / self.noise**2)
        left = values.copy()
        for at in batches(len(values)):
            left[at] -= self.basis.features(self.points[at]) @ (self.scale * weights)
        return left


def window_slopes(window: SuiteWindow, sensors: FloatArray, prior: Hyperparameters) -> WindowSlopes:
    """Return the readings of a window beside its field; parameters of ``suite_likelihood``."""
    readings, basis = window.readings, window.basis
    undone = undistorted(readings, sensors)
    points = undone.points - undone.points.mean(axis=0) + window.middle
    log_variance = basis.prior(prior).log_variance
    normal = normal_of(basis, TrainingSet(points, undone.field, np.ones(len(readings))))
    found, D = evidence(normal, log_variance, prior.noise), np.exp(0.5 * log_variance)
    predicted, gradient = basis.field_and_gradient(points, D * found.mean)
    places = _wide(place_slopes(readings, undone.lever), readings.sensor, len(sensors))
    places -= places.mean(axis=0)
    own = field_slopes(readings, undone.turned, undone.b)
    J = _wide(own, readings.sensor, len(sensors)) - gradient @ places
    r = undone.field - predicted
    return WindowSlopes(basis, prior.noise, undone, points, found, D, r, gradient, places, J)


def late_slopes(
    window: SuiteWindow, at: WindowSlopes, late: FloatArray, sensors: int
) -> FloatArray:
    """Return derivatives of residuals by how fast the clocks of sensors grow late, (N, 3, S).

    Parameters
    ----------
    window, at
        A window of S sensors, and its slopes.
    late
        Seconds by which a unit of that makes each reading late, shape (N,).
    sensors
        S.
    """
    readings, undone = window.readings, at.undone
    own = np.where(readings.sensor[:, None] == np.arange(sensors), late[:, None], 0.0)[:, None]
    places = place_slopes(readings, undone.lever)[:, :, TAU, None] * own
    places -= places.mean(axis=0)
    fields = field_slopes(readings, undone.turned, undone.b)[:, :, TAU, None] * own
    return np.asarray(fields - at.gradient @ places)


def _volume_change(readings: Readings, sensors: FloatArray) -> tuple[FloatArray, float]:
    """Return the sum of all ``log |det C|`` by the sensors' parameters, (16 S,), and itself."""
    slope, count = np.zeros(sensors.shape), np.bincount(readings.sensor, minlength=len(sensors))
    matrices = sensors[:, C].reshape(-1, 3, 3)
    slope[:, C] = (count[:, None, None] * np.linalg.inv(matrices).transpose(0, 2, 1)).reshape(-1, 9)
    _, log_det = np.linalg.slogdet(matrices)
    return slope.ravel(), float(count @ log_det)


def _wide(own: FloatArray, sensor: IntArray, count: int) -> FloatArray:
    """Return derivatives by the parameters of each reading's sensor by those of all sensors.

    From shape (N, 3, 16) to (N, 3, 16 S).
    """
    wide = np.zeros((len(own), 3, count, SIZE))
    wide[np.arange(len(own)), :, sensor] = own
    return wide.reshape(len(own), 3, -1)


def place_slopes(readings: Readings, lever: FloatArray) -> FloatArray:
    """Return derivatives of the places of readings by their sensors' parameters, (N, 3, 16).

    ``lever`` is where the sensors are in the lidar frame, shape (N, 3) or (3,).
    """
    R, J = readings.R_map_lidar, np.zeros((len(readings), 3, SIZE))
    J[:, :, T] = R
    if readings.motion is not None:
        w, v = readings.motion.twist_lidar[:, :3], readings.motion.twist_lidar[:, 3:]
        J[:, :, TAU] = np.einsum("nij,nj->ni", R, v + np.cross(w, lever))
    return J


def field_slopes(readings: Readings, turned: FloatArray, b: FloatArray) -> FloatArray:
    """Return derivatives of undistorted fields b by their sensors' parameters, (N, 3, 16).

    ``turned`` takes a change of a reading to that of its field in the map frame, (N, 3, 3).
    """
    J = np.zeros((len(readings), 3, SIZE))
    J[:, :, C] = -(turned[:, :, :, None] * b[:, None, None, :]).reshape(-1, 3, 9)
    J[:, :, H] = -turned
    if readings.motion is not None:
        w = readings.motion.twist_lidar[:, :3]
        J[:, :, TAU] = np.einsum("nij,nj->ni", readings.R_map_lidar, np.cross(w, b))
    return J
