r"""How likely a path is by the readings of its sensors, with the field integrated out.

With readings z on a path X, features F of the field's m weights, which are N(0, I), the distortion
C, H of each one's sensor, and T the covariance of the noise,

.. math::
    -\log p(z | X) = \frac{1}{2} r^T K^{-1} r + \frac{1}{2} \log |K|, \quad r = z - H, \quad
    K = \Phi \Phi^T + T, \quad \Phi_i = C R_i^T F(x_i)

A path and its field that are moved together are as likely as before. In a graph of both the weights
move along a circle then, and a tangent takes that for more weight: so a path seems to be known
where nothing holds it. Here weights are no variables.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.spatial.transform import Rotation

from l2m_factors import MagneticReadings, reading_residuals, skew
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.unknown_field.sensor_noise import AXES
from l2m_gtsam.slam.unknown_field.tiled_drive import FieldWithWeights
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

# The inverse of the covariance of N readings' noise along one axis, times rows (N, q).
InverseNoise = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class PathReadings:
    """N readings of S sensors at an estimate of a path.

    Attributes
    ----------
    R, p
        The lidar at each reading in the frame of the field, (N, 3, 3) and (N, 3), metres.
    z
        What was read, along the axes of the sensor, uT, shape (N, 3).
    sensor
        Number of each one's sensor, shape (N,).
    """

    R: FloatArray
    p: FloatArray
    z: FloatArray
    sensor: IntArray


@dataclass(frozen=True)
class DensitySlopes:
    """The cost of a path, minus the logarithm of its density but for constants, and its slopes.

    Attributes
    ----------
    cost
        In nats.
    by_path
        Derivative by a right perturbation of the lidar at each reading, shape (N, 6).
    by_sensor
        By (t, C row by row, H) of each sensor, shape (S, 15).
    """

    cost: float
    by_path: FloatArray
    by_sensor: FloatArray


@dataclass(frozen=True)
class WeightsOfPath:
    """What is known of a field's m weights once path and sensor are given.

    Attributes
    ----------
    covariance
        Of the weights on a given path, shape (m, m).
    by_path
        Derivative of the likeliest weights by a right perturbation of the lidar at each reading,
        shape (m, N, 6).
    by_sensor
        By (t, C row by row, H), shape (m, 15).
    """

    covariance: FloatArray
    by_path: FloatArray
    by_sensor: FloatArray


class PathDensity:
    """The density of readings on paths near an estimate.

    Parameters
    ----------
    readings
        At the estimate.
    field
        Of m weights.
    noise
        Of the readings.
    """

    def __init__(self, readings: PathReadings, field: WholeField, noise: InverseNoise) -> None:
        self._readings, self._field, self._noise = readings, field, noise

    def slopes(self, moved: FloatArray, sensors: FloatArray) -> DensitySlopes:
        """Return the cost and its slopes at a path beside the estimate.

        Parameters
        ----------
        moved
            Right perturbations of the lidar's poses, so small that their rotations add, (N, 6).
        sensors
            t, C row by row, and H of each, shape (S, 15).
        """
        at, N, m = self._readings, len(self._readings.z), len(self._field)
        own_sensor = sensors[at.sensor]
        t, H = own_sensor[:, :3], own_sensor[:, 12:]
        C = own_sensor[:, 3:12].reshape(N, AXES, AXES)
        C_back = C.transpose(0, 2, 1)
        turn = moved[:, :3]
        R = at.R @ Rotation.from_rotvec(turn).as_matrix()
        x = at.p + np.einsum("nij,nj->ni", at.R, moved[:, 3:]) + np.einsum("nij,nj->ni", R, t)
        own = R.transpose(0, 2, 1) @ self._field.features(x)
        features = C @ own
        flat = features.reshape(AXES * N, m)
        white = self._noise(features.reshape(N, -1)).reshape(AXES * N, m)
        lower = cholesky(np.eye(m) + flat.T @ white, lower=True)
        r = at.z - H
        by_noise = self._noise(r).ravel()
        pulled = flat.T @ by_noise
        # Of the weights. The matrix is 1 and more, so that its inverse loses nothing, and a product
        # with it takes half of the time of two triangular solves.
        covariance = cho_solve((lower, True), np.eye(m))
        u = covariance @ pulled
        alpha = by_noise - white @ u  # K^-1 r
        fit = 0.5 * (r.ravel() @ by_noise - pulled @ u)
        # d cost = tr(W^T d Phi) with W = T^-1 Phi (I + Phi^T T^-1 Phi)^-1 - alpha u^T.
        W = white @ covariance
        W -= np.outer(alpha, u)
        by_features = W.reshape(N, AXES, m)
        by_C = by_features @ own.transpose(0, 2, 1)  # of each reading, (N, 3, 3)
        by_place = self._field.by_points(x, (R @ C_back) @ by_features)
        # A turn w takes b to b - w x b, and the sensor by R (w x t).
        lever = np.einsum("nji,nj->ni", R, by_place)
        products = C_back @ by_C  # of the derivative by b with b
        by_turn = np.stack(
            [products[:, j, k] - products[:, k, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1
        )
        by_turn += np.cross(t, lever)
        by_turn += 0.5 * np.cross(turn, by_turn)  # d Exp(w), to first order in w
        by_shift = np.einsum("nji,nj->ni", at.R, by_place)
        by_own = np.hstack([lever, by_C.reshape(N, -1), -alpha.reshape(N, AXES)])
        by_sensor = np.zeros_like(sensors)
        np.add.at(by_sensor, at.sensor, by_own)
        return DensitySlopes(
            cost=float(fit + np.log(np.diag(lower)).sum()),
            by_path=np.hstack([by_turn, by_shift]),
            by_sensor=by_sensor,
        )

    def weights(self, weights: FloatArray, sensor: FloatArray) -> WeightsOfPath:
        """Return how the likeliest weights, (m,), follow path and one sensor, to first order.

        Residuals count as small beside the field: their product with its slopes is left out, as in
        a Gauss-Newton step.

        Parameters
        ----------
        weights
            The likeliest at the estimate, shape (m,).
        sensor
            t, C row by row, and H, shape (15,).
        """
        at, N, m = self._readings, len(self._readings.z), len(self._field)
        t, C = sensor[:3], sensor[3:12].reshape(3, 3)
        R_back, x = at.R.transpose(0, 2, 1), at.p + at.R @ t
        features = C @ R_back @ self._field.features(x)
        white = self._noise(features.reshape(N, -1))
        flat = features.reshape(AXES * N, m)
        lower = cholesky(np.eye(m) + flat.T @ white.reshape(AXES * N, m), lower=True)
        covariance = cho_solve((lower, True), np.eye(m))
        # The likeliest are S P^T T^-1 (z - H) with S the covariance: dw = -S P^T T^-1 d(P w + H).
        back = -covariance @ white.reshape(AXES * N, m).T
        readings = MagneticReadings(np.zeros(N, dtype=np.int64), at.R, at.p, at.z)
        known = FieldWithWeights(self._field, weights)
        here = reading_residuals(readings, known, t[None], sensor[None, 3:])
        by_turn = C @ skew(here.b_lidar) - here.de_dt @ skew(t[None])
        by_lidar = np.concatenate([by_turn, here.de_dt], axis=2)
        by_sensor = np.concatenate([here.de_dt, here.de_dD], axis=2)
        own = back.reshape(m, N, AXES)
        return WeightsOfPath(
            covariance,
            np.einsum("mna,nap->mnp", own, by_lidar),
            back @ by_sensor.reshape(AXES * N, -1),
        )
