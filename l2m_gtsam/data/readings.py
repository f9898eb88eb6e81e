"""Readings with the lidar's pose at each, and the account of what was dropped."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data.arrays import BoolArray, FloatArray, IntArray
from l2m_gtsam.data.tables import RowTable, TimedTable


@dataclass(frozen=True)
class LidarMotion(RowTable):
    """How the lidar moves at N readings, and when their poses were taken.

    Attributes
    ----------
    twist_lidar
        Angular velocity in rad/s and linear velocity in m/s, both in the lidar frame, shape (N, 6).
    acceleration_lidar
        How these grow, rad/s^2 and m/s^2, in the frame of the lidar at the reading, shape (N, 6).
    offset
        Time offset in seconds: the poses are those at stamp + offset, shape (N,).
    """

    twist_lidar: FloatArray
    acceleration_lidar: FloatArray
    offset: FloatArray

    @classmethod
    def steady(cls, twist_lidar: FloatArray) -> "LidarMotion":
        """Return motion at constant velocities, shape (N, 6), with poses at the stamps."""
        return cls(twist_lidar, np.zeros_like(twist_lidar), np.zeros(len(twist_lidar)))


@dataclass(frozen=True)
class Readings(TimedTable):
    """Readings of all sensors with the lidar's pose at each, as one batch.

    Attributes
    ----------
    sensors
        Names, in the order that ``sensor`` counts.
    sensor
        Index into ``sensors`` of each reading, ascending, shape (N,).
    stamp_ns
        Times in nanoseconds, shape (N,).
    R_map_lidar
        Rotations of the lidar at each reading, shape (N, 3, 3).
    p_map_lidar
        Positions of the lidar in the map in metres, shape (N, 3).
    field
        Measured field in the sensor's frame in microtesla, finite, shape (N, 3).
    motion
        How the lidar moves there, if that is known: without it no time offset can be.
    pose_root
        Square roots L of the covariances of the poses' errors, ``true = measured Exp(L u)``, in the
        lidar frame, rotation (rad) before translation (m), shape (N, 6, 6); absent for exact poses.
    regressors
        Recorded numbers whose field may be part of the readings, each in its own unit, shape
        (N, K); zero where they do not act on a sensor, absent where none were recorded.
    drive
        Which drive each is of, ascending for each sensor, shape (N,); absent where there is one.
    relative_noise
        How large the noise of each is beside its sensor's, shape (N,); absent where it is one.
    """

    sensors: tuple[str, ...]
    sensor: IntArray
    stamp_ns: IntArray
    R_map_lidar: FloatArray
    p_map_lidar: FloatArray
    field: FloatArray
    motion: LidarMotion | None = None
    pose_root: FloatArray | None = None
    regressors: FloatArray | None = None
    drive: IntArray | None = None
    relative_noise: FloatArray | None = None

    @property
    def of_drive(self) -> IntArray:
        """Which drive each is of, shape (N,); 0 where there is one."""
        return np.zeros(len(self), dtype=np.int64) if self.drive is None else self.drive

    @property
    def noise_ratio(self) -> FloatArray:
        """How large the noise of each is beside its sensor's, shape (N,)."""
        return np.ones(len(self)) if self.relative_noise is None else self.relative_noise

    def noise(self, of_sensors: FloatArray) -> FloatArray:
        """Return the noise of each in uT, shape (N,), by that of the S sensors, shape (S,)."""
        return np.asarray(of_sensors[self.sensor] * self.noise_ratio)

    def select(self, keep: BoolArray) -> "Readings":
        """Return the readings where ``keep``, shape (N,), is true."""
        return self[np.flatnonzero(keep)]

    def rows_of(self, index: int) -> slice:
        """Return the rows of the sensor with this index."""
        low, high = np.searchsorted(self.sensor, [index, index + 1])
        return slice(int(low), int(high))

    def alone(self, index: int) -> "Readings":
        """Return the readings of the sensor with this index, as of the only one."""
        own = self[np.arange(len(self))[self.rows_of(index)]]
        return replace(own, sensors=(self.sensors[index],), sensor=np.zeros_like(own.sensor))


@dataclass(frozen=True)
class SaturatedAxis:
    """A limit of a sensor's range that readings exceed.

    Attributes
    ----------
    axis
        "x", "y" or "z" of the sensor.
    limit
        The value that is reported beyond it, uT.
    readings, of
        How many readings at different places have it, and how many there are.
    """

    axis: str
    limit: float
    readings: int
    of: int

    @property
    def share(self) -> float:
        """Share of the readings at the limit."""
        return self.readings / self.of


@dataclass(frozen=True)
class SyncCounts:
    """How many readings of one sensor were kept and why the others were not.

    ``limits`` are those of its range that the ``saturated`` readings exceed. Those ``elsewhere``
    are in parts of a large map that do not count.
    """

    received: int
    not_finite: int
    repeated: int
    outside_trajectory: int
    in_pose_gap: int
    thinned: int
    kept: int
    without_regressor: int = 0
    elsewhere: int = 0
    saturated: int = 0
    limits: tuple[SaturatedAxis, ...] = ()


@dataclass(frozen=True)
class Synchronised:
    """Readings with poses, and the account of what was dropped, sensor by sensor."""

    readings: Readings
    counts: tuple[SyncCounts, ...]
