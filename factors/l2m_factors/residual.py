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


@dataclass(frozen=True)
class ReadingResiduals:
    """Residuals of N readings and what their derivatives are made of.

    Attributes
    ----------
    residual
        ``e = C b + H - z`` in microtesla, shape (N, 3).
    de_dt
        Derivative by ``t_lidar_mag`` in microtesla per metre, shape (N, 3, 3).
    b_lidar
        Field that the map predicts in the lidar frame in microtesla, shape (N, 3).
    de_dS
        Derivative by the time offset in microtesla per second, shape (N, 3, 1); zero without
        motion.
    """

    residual: FloatArray
    de_dt: FloatArray
    b_lidar: FloatArray
    de_dS: FloatArray

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
    R_lidar_map = R.transpose(0, 2, 1)
    b_lidar = np.einsum("nij,nj->ni", R_lidar_map, field)
    C = distortion[:, :9].reshape(-1, 3, 3)[sensor]
    residual = np.einsum("nij,nj->ni", C, b_lidar) + distortion[sensor, 9:] - readings.field
    slope = R_lidar_map @ gradient @ R
    rate = field_rate(b_lidar, slope, t_lidar_mag, motion)
    return ReadingResiduals(residual, C @ slope, b_lidar, C @ rate[:, :, None])


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
