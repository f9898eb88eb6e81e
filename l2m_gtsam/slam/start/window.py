"""The first metres of a drive as one rigid pattern of fields, to be matched with a map."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive, KnownSensors, stacked
from l2m_gtsam.slam.key_pose_readings import evenly_spread

AXES = 3


@dataclass(frozen=True)
class Pattern:
    """Fields of N readings in the levelled frame of odometry, with its origin at one of them.

    Attributes
    ----------
    x
        Positions in metres, shape (N, 3).
    field
        With distortions undone, uT, shape (N, 3).
    variance
        Of the field per axis without the map's share, uT^2, shape (N,).
    drift_m
        Standard deviation of ``x`` per axis by odometry's drift, metres, shape (N,).
    tilt
        Standard deviation of the vertical about each axis, rad.
    origin
        The frame's origin in the frame of odometry, metres, shape (3,).
    """

    x: FloatArray
    field: FloatArray
    variance: FloatArray
    drift_m: FloatArray
    tilt: float
    origin: FloatArray

    def __getitem__(self, rows: IntArray) -> "Pattern":
        return replace(
            self,
            x=self.x[rows],
            field=self.field[rows],
            variance=self.variance[rows],
            drift_m=self.drift_m[rows],
        )

    @property
    def radius(self) -> float:
        """Largest horizontal distance from the origin, metres."""
        return float(np.linalg.norm(self.x[:, :2], axis=1).max())


@dataclass(frozen=True)
class DriveWindow:
    """The first K key poses of a drive and N readings on them.

    Attributes
    ----------
    path_m
        Length of the path in metres.
    R, p
        Key poses in the frame of the first, shapes (K, 3, 3) and (K, 3), metres.
    covariance
        Of odometry's steps between them, shape (K - 1, 6, 6).
    readings
        N readings relative to them.
    sensors
        Calibrations of the S sensors.
    R_odom_lidar
        Rotation of the first key pose in the frame of odometry, whose z axis is up, shape (3, 3).
    p_odom_lidar
        Its position there, metres, shape (3,).
    """

    path_m: float
    R: FloatArray
    p: FloatArray
    covariance: FloatArray
    readings: KeyPoseReadings
    sensors: KnownSensors
    R_odom_lidar: FloatArray
    p_odom_lidar: FloatArray

    def __len__(self) -> int:
        return len(self.readings)

    def pattern(self, tilt: float) -> Pattern:
        """Return the readings as a pattern whose frame is up within ``tilt`` radians."""
        key, sensor = self.readings.key_pose, self.readings.sensor
        first = self.readings.placed(self.R[key], self.p[key])
        R = self.R_odom_lidar @ first.R_map_lidar
        lever = np.einsum("nij,nj->ni", first.R_map_lidar, self.sensors.t[sensor])
        x = (lever + first.p_map_lidar) @ self.R_odom_lidar.T + self.p_odom_lidar
        C = self.sensors.distortion[sensor, :9].reshape(-1, 3, 3)
        b = np.linalg.solve(C, (first.field - self.sensors.distortion[sensor, 9:])[..., None])[
            ..., 0
        ]
        middle = central(x)
        drift = self._drift(int(key[middle]))[key]
        known = self._variance(C, np.asarray(b), drift[:, 0])
        field = np.einsum("nij,nj->ni", R, b)
        return Pattern(x - x[middle], field, known, np.sqrt(drift[:, 1]), tilt, x[middle])

    def _variance(self, C: FloatArray, b: FloatArray, turn: FloatArray) -> FloatArray:
        """Return variances per axis from noise, calibration and rotation (rad^2), shape (N,)."""
        sensor = self.readings.sensor
        at = np.diagonal(self.sensors.covariance, axis1=1, axis2=2)[sensor]
        b2 = np.einsum("ni,ni->n", b, b)
        read = self.sensors.noise[sensor] ** 2 + at[:, 12:].mean(axis=1)
        read = read + b2 * at[:, 3:12].mean(axis=1)
        scale2 = np.linalg.det(C) ** (-2 / AXES)
        return np.asarray(scale2 * read + 2 / AXES * b2 * turn)

    def _drift(self, key: int) -> FloatArray:
        """Return variances of rotation (rad^2) and position (m^2) per axis from a key pose, (K, 2).

        A rotation error moves all beyond it, in both directions from the key pose.
        """
        K, variance = len(self.p), np.zeros((len(self.p), 2))
        turn, shift = (
            np.trace(self.covariance[:, at, at], axis1=1, axis2=2) / AXES
            for at in (slice(0, 3), slice(3, 6))
        )
        apart2 = np.sum((self.p[:, None] - self.p) ** 2, axis=2)
        for k in range(K):
            steps = np.arange(min(k, key), max(k, key))
            lever2 = 2 / AXES * apart2[k, steps + 1]
            variance[k] = turn[steps].sum(), np.sum(shift[steps] + turn[steps] * lever2)
        return variance


def central(x: FloatArray) -> int:
    """Return the row from which the furthest other one, shape (N, 3), is nearest."""
    apart = np.linalg.norm(x[:, None, :2] - x[:, :2], axis=2)
    return int(apart.max(axis=1).argmin())


def window_of(drive: Drive, path_m: float, most: int) -> DriveWindow:
    """Return the first metres of a drive.

    Parameters
    ----------
    drive
        K key poses in the frame of odometry.
    path_m
        Limit of the path in metres.
    most
        Limit of readings.
    """
    R, p = stacked(drive.dead_reckoning())
    path = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1)))
    count = max(int(np.searchsorted(path, path_m, side="right")), min(2, len(path)))
    own = drive.readings[np.flatnonzero(drive.readings.key_pose < count)]
    return DriveWindow(
        path_m=float(path[count - 1]),
        R=R[0].T @ R[:count],
        p=(p[:count] - p[0]) @ R[0],
        covariance=drive.steps.as_walk(path_m).covariance[: count - 1],
        readings=own[thinned(own, most)],
        sensors=drive.sensors,
        R_odom_lidar=R[0],
        p_odom_lidar=p[0],
    )


def thinned(readings: KeyPoseReadings, most: int) -> IntArray:
    """Return rows of one reading of each sensor on each key pose, at most so many in all."""
    rows = evenly_spread(np.column_stack([readings.key_pose, readings.sensor]), 1)
    return np.asarray(rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(np.int64)])
