"""What the map predicts at the readings, at an estimate of poses and sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import D, KeyPoseReadings, MagneticReadings, T, X, skew
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.slam.drive import KnownSensors, stacked
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening


@dataclass(frozen=True)
class PlacedReadings:
    """N readings at an estimate of poses and sensors.

    Attributes
    ----------
    readings
        The lidar's poses in the map.
    x
        Positions of the sensors in the map in metres, shape (N, 3).
    C
        Distortion matrix of each one's sensor, shape (N, 3, 3).
    """

    readings: MagneticReadings
    x: FloatArray
    C: FloatArray

    @classmethod
    def of(cls, readings: MagneticReadings, sensors: KnownSensors) -> "PlacedReadings":
        """Return readings with their sensors' positions and distortions."""
        lever = np.einsum("nij,nj->ni", readings.R_map_lidar, sensors.t[readings.sensor])
        C = sensors.distortion[:, :9].reshape(-1, 3, 3)[readings.sensor]
        return cls(readings, lever + readings.p_map_lidar, C)

    def field(self, sensors: KnownSensors) -> FloatArray:
        """Return the measured field in the map's frame, distortion undone, uT, shape (N, 3)."""
        at = self.readings
        H = sensors.distortion[at.sensor, 9:]
        b_lidar = np.linalg.solve(self.C, (at.field - H)[:, :, None])
        return np.asarray((at.R_map_lidar @ b_lidar)[:, :, 0])


@dataclass(frozen=True)
class MapPrediction:
    """What the map predicts at N readings.

    Attributes
    ----------
    placed
        The readings and the sensors' positions.
    inside
        Whether the map has data there, shape (N,).
    map_variance
        Of the map's field per axis of the map in uT^2, shape (N, 3); infinite outside.
    residual
        ``C b + H - z`` in uT, shape (N, 3); NaN outside.
    by_lidar
        Its derivative by a right perturbation of the lidar's pose, rotation in uT/rad before
        translation in uT/m, shape (N, 3, 6); zero outside.
    """

    placed: PlacedReadings
    inside: BoolArray
    map_variance: FloatArray
    residual: FloatArray
    by_lidar: FloatArray

    def whitening(
        self,
        noise: FloatArray,
        map_variance: FloatArray | None = None,
        extra: FloatArray | None = None,
    ) -> FloatArray:
        """Return each residual's whitening matrix, 1/uT, shape (N, 3, 3); zero outside of the map.

        Parameters
        ----------
        noise
            Standard deviations of the sensors' noise in uT, shape (S,).
        map_variance
            Instead of the map's own, per axis in uT^2, shape (N, 3).
        extra
            Covariance that residuals have in addition, uT^2, shape (N, 3, 3).
        """
        of_reading = noise[self.placed.readings.sensor]
        return self.whitening_of(of_reading, map_variance, extra)

    def whitening_of(
        self,
        noise: FloatArray,
        map_variance: FloatArray | None = None,
        extra: FloatArray | None = None,
    ) -> FloatArray:
        """Return the same for a standard deviation of each reading's noise in uT, shape (N,)."""
        variance = self.map_variance if map_variance is None else map_variance
        W = np.zeros((len(self.inside), 3, 3))
        rows = np.flatnonzero(self.inside)
        at = self.placed.readings
        share = map_covariance(self.placed.C[rows], at.R_map_lidar[rows], variance[rows])
        if extra is not None:
            share = share + extra[rows]
        W[rows] = whitening(reading_covariance(noise[rows], share))
        return W

    def squared(self, W: FloatArray) -> FloatArray:
        """Return squared lengths of whitened residuals, shape (N,); zero outside of the map."""
        e = np.einsum("nij,nj->ni", W, np.where(self.inside[:, None], self.residual, 0.0))
        return np.asarray(np.einsum("ni,ni->n", e, e))


def place_readings(
    readings: KeyPoseReadings,
    poses: Mapping[int, gtsam.Pose3] | Sequence[gtsam.Pose3],
    sensors: KnownSensors,
) -> PlacedReadings:
    """Return readings at poses in the map.

    Parameters
    ----------
    readings
        N readings relative to key poses.
    poses
        Estimates of their key poses at least, by number.
    sensors
        Estimates of the S sensors.
    """
    numbers, slot = np.unique(readings.key_pose, return_inverse=True)
    R, p = stacked([poses[int(k)] for k in numbers])
    return PlacedReadings.of(readings.placed(R[slot], p[slot]), sensors)


def predict(field_map: QueryableMap, where: PlacedReadings, sensors: KnownSensors) -> MapPrediction:
    """Query the map once for all readings, and compare with what was measured."""
    sample, at = field_map.query(where.x), where.readings
    R_back = at.R_map_lidar.transpose(0, 2, 1)
    b = np.einsum("nij,nj->ni", R_back, sample.field)
    predicted = np.einsum("nij,nj->ni", where.C, b) + sensors.distortion[at.sensor, 9:]
    by_shift = R_back @ sample.gradient @ at.R_map_lidar
    # As of a key pose (``key_pose_residuals``), here by a right perturbation of the lidar itself.
    by_turn = skew(b) - by_shift @ skew(sensors.t[at.sensor])
    by_lidar = where.C @ np.concatenate([by_turn, by_shift], axis=2)
    by_lidar[~sample.inside] = 0.0
    return MapPrediction(where, sample.inside, sample.variance, predicted - at.field, by_lidar)


def poses_in(values: gtsam.Values, count: int) -> list[gtsam.Pose3]:
    """Return the key poses of a drive."""
    return [values.atPose3(X(k)) for k in range(count)]


def sensors_in(values: gtsam.Values, known: KnownSensors) -> KnownSensors:
    """Return sensors with the calibrations in values; the known ones if there are none."""
    count = range(len(known.names))
    if not values.exists(T(0)):
        return known
    t = np.stack([values.atPoint3(T(i)) for i in count])
    return replace(known, t=t, distortion=np.stack([values.atVector(D(i)) for i in count]))
