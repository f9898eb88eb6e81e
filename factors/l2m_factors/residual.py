r"""The residual of magnetic readings and its derivatives, on arrays of readings at once.

.. math::
    x = R t + p, \quad b = R^T B(x), \quad e = C b + H - z

    \partial e / \partial t = C R^T G(x) R, \quad
    \partial e / \partial C = I_3 \otimes b^T, \quad
    \partial e / \partial H = I_3

with C taken row by row. The paper L2M-Calib prints the first derivative as R C grad M; the order
above is the one that finite differences confirm.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FieldMap, FloatArray


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
    """

    sensor: npt.NDArray[np.int64]
    R_map_lidar: FloatArray
    p_map_lidar: FloatArray
    field: FloatArray

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
    """

    residual: FloatArray
    de_dt: FloatArray
    b_lidar: FloatArray

    @cached_property
    def de_dD(self) -> FloatArray:
        """Derivative by (C row by row, H), shape (N, 3, 12)."""
        J = np.zeros((len(self.b_lidar), 3, 12))
        for axis in range(3):
            J[:, axis, 3 * axis : 3 * axis + 3] = self.b_lidar
            J[:, axis, 9 + axis] = 1.0
        return J


def reading_residuals(
    readings: MagneticReadings, field_map: FieldMap, t: FloatArray, distortion: FloatArray
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
    """
    R, sensor = readings.R_map_lidar, readings.sensor
    x = np.einsum("nij,nj->ni", R, t[sensor]) + readings.p_map_lidar
    field, gradient = field_map.field_and_gradient(x)
    R_lidar_map = R.transpose(0, 2, 1)
    b_lidar = np.einsum("nij,nj->ni", R_lidar_map, field)
    C = distortion[:, :9].reshape(-1, 3, 3)[sensor]
    residual = np.einsum("nij,nj->ni", C, b_lidar) + distortion[sensor, 9:] - readings.field
    return ReadingResiduals(residual, C @ R_lidar_map @ gradient @ R, b_lidar)
