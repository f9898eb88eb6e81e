r"""Magnetic readings taken from poses that are variables: ``X(k)``.

A reading hangs on a key pose ``(R_k, p_k)`` by a fixed transform, from odometry: the lidar at the
reading stands at ``(R, p)`` in the key pose's frame (what the error of that way does to it is in
``step``). With

.. math::
    t' = R t + p, \quad x = R_k t' + p_k, \quad b = R^T R_k^T B(x), \quad e = C b + H - z

and a right perturbation ``(w, v)`` of the key pose

.. math::
    \partial e / \partial v = C S R^T, \quad
    \partial e / \partial w = C [b]_\times R^T - C S R^T [t']_\times, \quad
    S = R^T R_k^T G(x) R_k R

The other derivatives are those of ``residual`` at the lidar's pose ``X(k) (R, p)``.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import covered, indices, numbers
from l2m_factors.field_map import DifferentiableMap, FloatArray
from l2m_factors.motion import PoseMotion, moved, skew
from l2m_factors.residual import MagneticReadings, ReadingResiduals, reading_residuals


@dataclass(frozen=True)
class KeyPoseReadings:
    """Readings of one or several magnetometers and how each hangs on a key pose.

    Attributes
    ----------
    key_pose
        Number k of the key pose ``X(k)`` of each reading, shape (N,).
    sensor
        Index of the sensor of each reading, shape (N,).
    R_key_lidar
        Rotations from the lidar at the reading to the key pose, shape (N, 3, 3).
    p_key_lidar
        Positions of the lidar at the reading in the frame of the key pose, metres, shape (N, 3).
    fraction
        How much of the step to key pose k + 1 lies behind each, from 0 to 1, shape (N,): as much
        of the step's error is in the way here.
    field
        Measured field in the sensor's frame in microtesla, shape (N, 3).
    motion
        How the lidar moves there; without it the readings' time offsets are no variables.
    """

    key_pose: npt.NDArray[np.int64]
    sensor: npt.NDArray[np.int64]
    R_key_lidar: FloatArray
    p_key_lidar: FloatArray
    fraction: FloatArray
    field: FloatArray
    motion: PoseMotion | None = None

    def __len__(self) -> int:
        return len(self.key_pose)

    def __getitem__(self, rows: npt.NDArray[np.int64]) -> "KeyPoseReadings":
        motion = self.motion
        if motion is not None:
            motion = PoseMotion(motion.twist_lidar[rows], motion.offset[rows])
        return KeyPoseReadings(
            self.key_pose[rows],
            self.sensor[rows],
            self.R_key_lidar[rows],
            self.p_key_lidar[rows],
            self.fraction[rows],
            self.field[rows],
            motion,
        )

    def checked(self) -> "KeyPoseReadings":
        """Return a copy that is nobody else's.

        Raises
        ------
        ValueError
            An array has another shape or a number that is not finite; the line names it.
        """
        sensor = indices("sensor", self.sensor)
        n = len(sensor)
        return KeyPoseReadings(
            indices("key_pose", self.key_pose, n),
            sensor,
            numbers("R_key_lidar", self.R_key_lidar, (n, 3, 3)),
            numbers("p_key_lidar", self.p_key_lidar, (n, 3)),
            numbers("fraction", self.fraction, (n,)),
            numbers("field", self.field, (n, 3)),
            None if self.motion is None else self.motion.checked(n),
        )

    def lidar_at(self, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where the lidar stood in the key pose's frame, (N, 3, 3) and (N, 3) in metres.

        Parameters
        ----------
        offset
            Time offset of each sensor in seconds, shape (S,); it counts for readings with motion.
        """
        if self.motion is None:
            return self.R_key_lidar, self.p_key_lidar
        return moved(self.R_key_lidar, self.p_key_lidar, self.motion, offset[self.sensor])

    def placed(self, R_map_key: FloatArray, p_map_key: FloatArray) -> MagneticReadings:
        """Return the readings with the lidar's poses in the map.

        Parameters
        ----------
        R_map_key, p_map_key
            The key pose of each reading, shapes (N, 3, 3) and (N, 3), metres.
        """
        R = R_map_key @ self.R_key_lidar
        p = np.einsum("nij,nj->ni", R_map_key, self.p_key_lidar) + p_map_key
        return MagneticReadings(self.sensor, R, p, self.field, self.motion)


@dataclass(frozen=True)
class KeyPoseResiduals:
    """Residuals of N readings on key poses and their derivatives.

    Attributes
    ----------
    reading
        Residuals and derivatives by calibration and time offset.
    de_dX
        Derivative by a right perturbation of the key pose, rotation in uT/rad before translation
        in uT/m, shape (N, 3, 6).
    """

    reading: ReadingResiduals
    de_dX: FloatArray


@dataclass(frozen=True)
class Calibrations:
    """Calibrations of S sensors.

    Attributes
    ----------
    t
        Positions in the lidar frame in metres, shape (S, 3).
    distortion
        C row by row and H in microtesla, shape (S, 12).
    offset
        Time offsets in seconds, shape (S,); they count for readings with motion.
    """

    t: FloatArray
    distortion: FloatArray
    offset: FloatArray

    @classmethod
    def zeros(cls, sensors: int) -> "Calibrations":
        """Return room for so many sensors."""
        return cls(np.zeros((sensors, 3)), np.zeros((sensors, 12)), np.zeros(sensors))

    def checked(self, sensor: npt.NDArray[np.int64]) -> "Calibrations":
        """Return a copy that is nobody else's, of the sensors of some readings at least.

        Parameters
        ----------
        sensor
            Index of the sensor of each reading, shape (n,).

        Raises
        ------
        ValueError
            A sensor has no calibration, or an array has another shape or a number that is not
            finite; the line names it.
        """
        S = len(self.t)
        covered("calibrations", S, sensor)
        return Calibrations(
            numbers("Calibrations.t", self.t, (S, 3)),
            numbers("Calibrations.distortion", self.distortion, (S, 12)),
            numbers("Calibrations.offset", self.offset, (S,)),
        )


def key_pose_residuals(
    readings: KeyPoseReadings,
    field_map: DifferentiableMap,
    R_map_key: FloatArray,
    p_map_key: FloatArray,
    sensors: Calibrations,
) -> KeyPoseResiduals:
    """Compare readings with what a map predicts from their key poses, in one batched query.

    Parameters
    ----------
    readings
        N readings.
    field_map
        The map.
    R_map_key, p_map_key
        The key pose of each reading, shapes (N, 3, 3) and (N, 3), metres.
    sensors
        The sensors.
    """
    placed = readings.placed(R_map_key, p_map_key)
    seen = reading_residuals(placed, field_map, sensors.t, sensors.distortion, sensors.offset)
    (R, p), t = readings.lidar_at(sensors.offset), sensors.t[readings.sensor]
    C = sensors.distortion[:, :9].reshape(-1, 3, 3)[readings.sensor]
    R_lidar_key = R.transpose(0, 2, 1)
    t_key_mag = np.einsum("nij,nj->ni", R, t) + p
    by_shift = seen.de_dt @ R_lidar_key
    # x = R_map_key t_key_mag + p_map_key. A right perturbation w of the key pose turns the field
    # seen by -w, so that b gains [b]_x w, and carries the sensor by -[t_key_mag]_x w; the map's
    # slope turns that into field.
    by_turn = C @ skew(seen.b_lidar) @ R_lidar_key - by_shift @ skew(t_key_mag)
    return KeyPoseResiduals(seen, np.concatenate([by_turn, by_shift], axis=2))
