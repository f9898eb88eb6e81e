"""Readings of one sensor beside what map and calibration make of them."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, Readings
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening


@dataclass(frozen=True)
class DriveEvidence:
    """All readings of a drive as the solve left them.

    Attributes
    ----------
    readings
        With their poses at the estimated time offsets.
    inside
        Which lie inside the map, shape (N,).
    rejected
        Which of these do not count, shape (N,).
    """

    readings: Readings
    inside: BoolArray
    rejected: BoolArray


@dataclass(frozen=True)
class SensorEvidence:
    """The N readings of one sensor inside the map.

    Attributes
    ----------
    readings
        With poses.
    used
        Which count, shape (N,).
    place
        Of the sensor in the map in metres, shape (N, 3).
    B_map, b_lidar
        Field that the map has there in uT, along the map's and the lidar's axes, shape (N, 3).
    residual
        ``C b + H - z`` in uT, shape (N, 3).
    map_share, pose_share
        Covariance that map and poses contribute to it in uT^2, shape (N, 3, 3).
    white
        Residuals in units of their standard deviations, independent along the axes, (N, 3).
    """

    readings: Readings
    used: BoolArray
    place: FloatArray
    B_map: FloatArray
    b_lidar: FloatArray
    residual: FloatArray
    map_share: FloatArray
    pose_share: FloatArray
    white: FloatArray

    @property
    def map_variance(self) -> FloatArray:
        """Mean variance per axis that the map contributes in uT^2, shape (N,)."""
        return np.asarray(np.einsum("nii->n", self.map_share) / 3)


def sensor_evidence(
    drive: DriveEvidence, sensor: SensorCalibration, field_map: QueryableMap
) -> SensorEvidence:
    """Return what map and calibration make of the readings of one sensor that was solved."""
    index = drive.readings.sensors.index(sensor.sensor)
    own = np.arange(len(drive.inside))[drive.readings.rows_of(index)]
    own = own[drive.inside[own]]
    place = _places(drive.readings[own], sensor)
    # The last step of the solve may have carried a reading over the edge of the map.
    whole = field_map.query(place)
    own, place, sample = own[whole.inside], place[whole.inside], whole.select(whole.inside)
    readings, C = drive.readings[own], sensor.distortion.C
    R = readings.R_map_lidar
    # e = C R^T B(R t + p) + H - z, with covariance noise^2 I + C R^T V R C^T + the poses' share.
    b = np.einsum("nji,nj->ni", R, sample.field)
    residual = sensor.distortion.apply(b) - readings.field
    map_share = map_covariance(np.broadcast_to(C, R.shape), R, sample.variance)
    poses = _pose_share(readings, sensor, sample, b)
    W = whitening(reading_covariance(sensor.noise * readings.noise_ratio, map_share + poses))
    return SensorEvidence(
        readings=readings,
        used=~drive.rejected[own],
        place=place,
        B_map=sample.field,
        b_lidar=b,
        residual=residual,
        map_share=map_share,
        pose_share=poses,
        white=np.asarray(np.einsum("nij,nj->ni", W, residual)),
    )


def _places(readings: Readings, sensor: SensorCalibration) -> FloatArray:
    """Return where a sensor was at its readings in the map in metres, shape (N, 3)."""
    turned = np.einsum("nij,j->ni", readings.R_map_lidar, sensor.t_lidar_mag)
    return np.asarray(turned + readings.p_map_lidar)


def _pose_share(
    readings: Readings, sensor: SensorCalibration, sample: FieldSample, b: FloatArray
) -> FloatArray:
    """Return what the poses' errors contribute to each residual, (N, 3, 3); docs/maths.md, 2."""
    if readings.pose_root is None:
        return np.zeros((len(b), 3, 3))
    R = readings.R_map_lidar
    # A pose T Exp(w, v) turns the sensor by w and moves it by v - t x w, in the lidar frame:
    # db = (b x - G t x) w + G v with G = R^T dB/dp R.
    G = np.einsum("nji,njk,nkl->nil", R, sample.gradient, R)
    turned = cross(b) - G @ cross(sensor.t_lidar_mag[None])
    A = sensor.distortion.C @ np.concatenate([turned, G], axis=2) @ readings.pose_root
    return np.asarray(A @ A.transpose(0, 2, 1))


def cross(v: FloatArray) -> FloatArray:
    """Return the matrices of the cross products with vectors, shape (N, 3), as (N, 3, 3)."""
    return np.cross(np.eye(3), v[:, None])
