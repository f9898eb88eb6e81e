r"""The residual of magnetic readings and its derivatives, on arrays of readings at once.

.. math::
    x = R t + p, \quad b = R^T B(x), \quad e = C b + H - z

    \partial e / \partial t = C R^T G(x) R, \quad
    \partial e / \partial C = I_3 \otimes b^T, \quad
    \partial e / \partial H = I_3

    \partial e / \partial \tau = C \, ([b]_\times w + R^T G(x) R \, (v + w \times t))

with ``w, v`` the lidar's twist and ``tau`` the time offset: the pose is that at stamp + tau. C is
taken row by row. The paper L2M-Calib prints the first derivative as R C grad M; the order above
is the one that finite differences confirm.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import indices, numbers
from l2m_factors.field_map import DifferentiableMap, FloatArray
from l2m_factors.motion import PoseMotion, moved


@dataclass(frozen=True)
class MagneticReadings:
    """Readings of one or several magnetometers with the lidar's pose at each.

    Attributes
    ----------
    sensor
        Index of the sensor of each reading, shape (N,).
    R_map_lidar
        Rotations from lidar to map, shape (N, 3, 3).
    p_map_lidar
        Positions of the lidar in the map in metres, shape (N, 3).
    field
        Measured field in the sensor's frame in microtesla, shape (N, 3).
    motion
        How the lidar moves there; without it the readings' time offsets are no variables.
    """

    sensor: npt.NDArray[np.int64]
    R_map_lidar: FloatArray
    p_map_lidar: FloatArray
    field: FloatArray
    motion: PoseMotion | None = None

    def __len__(self) -> int:
        return len(self.sensor)

    def checked(self) -> "MagneticReadings":
        """Return a copy that is nobody else's.

        Raises
        ------
        ValueError
            An array has another shape or a number that is not finite; the line names it.
        """
        sensor = indices("sensor", self.sensor)
        n = len(sensor)
        return MagneticReadings(
            sensor,
            numbers("R_map_lidar", self.R_map_lidar, (n, 3, 3)),
            numbers("p_map_lidar", self.p_map_lidar, (n, 3)),
            numbers("field", self.field, (n, 3)),
            None if self.motion is None else self.motion.checked(n),
        )


@dataclass(frozen=True)
class ReadingResiduals:
    """Residuals of N readings; their derivatives are computed when they are asked for.

    Attributes
    ----------
    residual
        ``e = C b + H - z`` in microtesla, shape (N, 3).
    b_lidar
        Field b that the map predicts in the lidar frame in microtesla, shape (N, 3).
    gradient
        Derivative G of the map's field in microtesla per metre, shape (N, 3, 3).
    R_map_lidar
        Rotations from lidar to map, shape (N, 3, 3).
    C
        Of the sensor of each reading, shape (N, 3, 3).
    t_lidar_mag
        Its position in the lidar frame in metres, shape (N, 3).
    motion
        Of the lidar; none is rest.
    """

    residual: FloatArray
    b_lidar: FloatArray
    gradient: FloatArray
    R_map_lidar: FloatArray
    C: FloatArray
    t_lidar_mag: FloatArray
    motion: PoseMotion | None = None

    @cached_property
    def slope(self) -> FloatArray:
        """``R^T G R``: derivative of b by t in uT/m, shape (N, 3, 3)."""
        return np.asarray(self.R_map_lidar.transpose(0, 2, 1) @ self.gradient @ self.R_map_lidar)

    @cached_property
    def de_dt(self) -> FloatArray:
        """Derivative by ``t_lidar_mag`` in microtesla per metre, shape (N, 3, 3)."""
        return np.asarray(self.C @ self.slope)

    @cached_property
    def de_dS(self) -> FloatArray:
        """Derivative by the time offset in microtesla per second, (N, 3, 1); zero at rest."""
        if self.motion is None or self.motion.at_rest:
            return np.zeros((len(self.residual), 3, 1))
        rate = field_rate(self.b_lidar, self.slope, self.t_lidar_mag, self.motion)
        return np.asarray(self.C @ rate[:, :, None])

    @cached_property
    def de_dD(self) -> FloatArray:
        """Derivative by (C row by row, H), shape (N, 3, 12)."""
        J = np.zeros((len(self.b_lidar), 3, 12))
        for axis in range(3):
            J[:, axis, 3 * axis : 3 * axis + 3] = self.b_lidar
            J[:, axis, 9 + axis] = 1.0
        return J


def reading_residuals(
    readings: MagneticReadings,
    field_map: DifferentiableMap,
    t: FloatArray,
    distortion: FloatArray,
    offset: FloatArray | None = None,
) -> ReadingResiduals:
    """Compare readings with what a map predicts, in one batched query.

    Parameters
    ----------
    readings
        N readings of S sensors.
    field_map
        The map.
    t
        Position of each sensor in the lidar frame in metres, shape (S, 3).
    distortion
        C row by row and H in microtesla of each sensor, shape (S, 12).
    offset
        Time offset of each sensor in seconds, shape (S,), for readings with motion; if it is not
        given, poses stay as they are.
    """
    R, p, sensor, motion = readings.R_map_lidar, readings.p_map_lidar, readings.sensor, None
    if readings.motion is not None and offset is not None:
        motion = readings.motion.after(offset[sensor])
        R, p = moved(R, p, readings.motion, offset[sensor])
    t_lidar_mag = t[sensor]
    field, gradient = field_map.field_and_gradient(np.einsum("nij,nj->ni", R, t_lidar_mag) + p)
    b_lidar = np.einsum("nji,nj->ni", R, field)
    C = distortion[:, :9].reshape(-1, 3, 3)[sensor]
    residual = np.einsum("nij,nj->ni", C, b_lidar) + distortion[sensor, 9:] - readings.field
    return ReadingResiduals(residual, b_lidar, gradient, R, C, t_lidar_mag, motion)


def field_rate(
    b_lidar: FloatArray, slope: FloatArray, t: FloatArray, motion: PoseMotion | None
) -> FloatArray:
    """Return how fast the field at a sensor changes along a drive, uT/s in the lidar frame, (N, 3).

    Parameters
    ----------
    b_lidar
        Field in the lidar frame in uT, shape (N, 3).
    slope
        ``R^T G R``: its derivative by t in uT/m, shape (N, 3, 3).
    t
        Position of the sensor in the lidar frame in metres, shape (N, 3).
    motion
        Of the lidar; none is rest.
    """
    if motion is None or motion.at_rest:
        return np.zeros_like(b_lidar)
    w, v = motion.twist_lidar[:, :3], motion.twist_lidar[:, 3:]
    sweep = v + np.cross(w, t)
    return np.asarray(np.cross(b_lidar, w) + np.einsum("nij,nj->ni", slope, sweep))
