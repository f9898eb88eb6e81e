"""A magnetometer: how it sees the field, and where it is."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data.arrays import FloatArray, Matrix, Vector


@dataclass(frozen=True)
class Distortion:
    """How a magnetometer sees the field: ``B_meas = C @ B_lidar + H``.

    Attributes
    ----------
    C
        Distortion matrix, shape (3, 3): rotation lidar to sensor, scale, non-orthogonality and
        soft iron.
    H
        Offset in microtesla, shape (3,).
    """

    C: Matrix
    H: Vector

    @classmethod
    def identity(cls) -> "Distortion":
        """Return the distortion of an ideal sensor aligned with the lidar."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_vector(cls, vector: FloatArray) -> "Distortion":
        """Return the distortion from C row by row and H, shape (12,)."""
        return cls(vector[:9].reshape(3, 3), vector[9:])

    def vector(self) -> FloatArray:
        """Return C row by row and H, shape (12,)."""
        return np.concatenate([self.C.ravel(), self.H])

    def apply(self, b_lidar: FloatArray) -> FloatArray:
        """Return the readings for fields ``b_lidar`` in the lidar frame, shape (..., 3), uT."""
        return np.asarray(b_lidar @ self.C.T + self.H)

    def undo(self, b_meas: FloatArray) -> FloatArray:
        """Return the fields in the lidar frame for readings ``b_meas``, shape (..., 3), uT."""
        return np.asarray(np.linalg.solve(self.C, (b_meas - self.H).T).T)


@dataclass(frozen=True)
class CorrectedField:
    """Readings of one sensor with its distortion undone.

    Attributes
    ----------
    field
        In the axes of the lidar in microtesla, shape (N, 3); NaN where it is not known.
    covariance
        Of each, in square microtesla, shape (N, 3, 3); NaN where the field is.
    """

    field: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class KnownSensor:
    """A magnetometer whose place and distortion are known, as on a mapping suite or in a truth.

    Attributes
    ----------
    sensor
        Name.
    t_lidar_mag
        Position in the lidar frame in metres, shape (3,).
    distortion
        C and H.
    time_offset
        Of its clock in seconds: a reading's pose is that at stamp + offset.
    covariance
        Of (t, C row by row, H, time offset) in m, 1, uT and s, shape (16, 16); absent where they
        count as exact.
    common
        What its errors have in common with those of the other sensors of its file: the covariance
        of two of them is ``common_i @ common_j.T``, shape (16, r). Absent where it is nothing.
    """

    sensor: str
    t_lidar_mag: FloatArray
    distortion: Distortion
    time_offset: float = 0.0
    covariance: FloatArray | None = None
    common: FloatArray | None = None

    @classmethod
    def ideal(cls, sensor: str) -> "KnownSensor":
        """Return a sensor without distortion at the lidar's origin."""
        return cls(sensor, np.zeros(3), Distortion.identity())

    @property
    def is_ideal(self) -> bool:
        """Whether nothing is known of it: no distortion, at the lidar's origin, no sigmas."""
        ideal = KnownSensor.ideal(self.sensor).vector()
        return self.covariance is None and np.array_equal(self.vector(), ideal)

    def vector(self) -> FloatArray:
        """Return (t, C row by row, H) in m, 1 and uT, shape (15,)."""
        return np.concatenate([self.t_lidar_mag, self.distortion.vector()])
