r"""What errors of a suite's sensors do to the readings that a map is made of.

A reading stands for ``x = R t + p`` and ``y = R C^{-1} (z - H)``. With b the field in the lidar
frame and (w, v) the lidar's velocity at the reading,

.. math::
    dx = R dt + R (w \times t + v) d\tau, \quad
    dy = -R C^{-1} (dC\, b + dH) + R (w \times b) d\tau
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.maps.suite_errors import SHIFT, SIZE, SuiteErrors
from l2m_gtsam.solve.linear_algebra import right_divided

TIME = 15  # the column of the time offset


def suite_errors(readings: Readings, known: Sequence[KnownSensor]) -> SuiteErrors:
    """Return what the sensors' errors do to their readings.

    Parameters
    ----------
    readings
        With poses at their stamps and the sensors' time offsets, and with motion.
    known
        The S sensors, in the readings' order; those without a covariance count as exact.
    """
    shift = np.zeros((len(readings), SHIFT, SIZE))
    for index, sensor in enumerate(known):
        rows = readings.rows_of(index)
        shift[rows] = sensor_shift(readings, rows, sensor)
    names, every = tuple(each.sensor for each in known), np.arange(len(readings))
    return SuiteErrors(names, suite_covariance(known), every, readings.sensor, shift)


def sensor_shift(readings: Readings, rows: slice, sensor: KnownSensor) -> FloatArray:
    """Return the derivatives of (x, y) by the errors of the sensor that read rows, (n, 6, 16)."""
    if readings.motion is None:
        raise ValueError("the readings have no motion, so that no clock can be judged")
    R, twist = readings.R_map_lidar[rows], readings.motion.twist_lidar[rows]
    b_lidar = sensor.distortion.undo(readings.field[rows])
    undone = right_divided(R, sensor.distortion.C)
    shift = np.zeros((len(R), SHIFT, SIZE))
    shift[:, :3, :3] = R
    velocity = np.cross(twist[:, :3], sensor.t_lidar_mag) + twist[:, 3:]
    shift[:, :3, TIME] = np.einsum("nij,nj->ni", R, velocity)
    shift[:, 3:, 3:12] = -np.einsum("nij,nk->nijk", undone, b_lidar).reshape(-1, 3, 9)
    shift[:, 3:, 12:TIME] = -undone
    shift[:, 3:, TIME] = np.einsum("nij,nj->ni", R, np.cross(twist[:, :3], b_lidar))
    return shift


def suite_covariance(known: Sequence[KnownSensor]) -> FloatArray:
    """Return the covariance of all sensors' errors, shape (16 S, 16 S)."""
    exact = np.zeros((SIZE, SIZE))
    own = [exact if each.covariance is None else each.covariance for each in known]
    ranks = [each.common.shape[1] for each in known if each.common is not None]
    common = np.zeros((len(known), SIZE, max(ranks, default=0)))
    for root, each in zip(common, known, strict=True):
        if each.common is not None:
            root[:, : each.common.shape[1]] = each.common
    together = common.reshape(SIZE * len(known), -1)
    alone = [each - root @ root.T for each, root in zip(own, common, strict=True)]
    return np.asarray(together @ together.T + block_diag(*alone))
