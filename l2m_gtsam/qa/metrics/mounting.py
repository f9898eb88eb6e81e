"""C and H in terms of the mounting: gains, angles, axes."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.metrics import AxisOrder, Mounting

AXES = "xyz"
PAIRS = ((0, 1), (1, 2), (2, 0))


def mounting(sensor: SensorCalibration) -> Mounting:
    """Return gains, skews, rotation and hard iron of a sensor that was solved."""
    C = sensor.distortion.C
    turn = sensor.rotation_vector
    angle = float(np.linalg.norm(turn))
    about = turn / angle if angle > 0 else np.zeros(3)
    return Mounting(
        scale=row(gains(C)),
        skew_deg=row(skews_deg(C), 4),
        angle_deg=float(np.rad2deg(angle)),
        turned_about=row(about, 4),
        angle_sigma_deg=float(sensor.turn_sigma_deg.max()),
        hard_iron=float(np.linalg.norm(sensor.distortion.H)),
        axes=axis_order(C),
    )


def gains(C: FloatArray) -> FloatArray:
    """Return the gain of each sensor axis, shape (3,): a row of C is the axis in the lidar."""
    return np.asarray(np.linalg.norm(C, axis=1))


def sensor_axes(C: FloatArray) -> FloatArray:
    """Return the directions of the sensor's axes in the lidar frame as rows, shape (3, 3)."""
    length = gains(C)[:, None]
    return np.asarray(np.divide(C, length, out=np.zeros_like(C), where=length > 0))


def skews_deg(C: FloatArray) -> FloatArray:
    """Return by how much the angles xy, yz, zx between the axes are less than 90 degrees."""
    axes = sensor_axes(C)
    cosines = [axes[i] @ axes[j] for i, j in PAIRS]
    return np.asarray(np.rad2deg(np.arcsin(np.clip(cosines, -1, 1))))


def axis_order(C: FloatArray) -> AxisOrder:
    """Return the signed order of the lidar's axes that the sensor's axes are most like.

    That with the largest sum of cosines: an assignment problem.
    """
    axes = sensor_axes(C)
    # Each axis of the lidar once: the largest sum of |cosines| over all permutations.
    _, chosen = linear_sum_assignment(-np.abs(axes))
    cosine = axes[np.arange(3), chosen]
    sign = np.where(cosine < 0, -1.0, 1.0)
    order = np.zeros((3, 3))
    order[np.arange(3), chosen] = sign
    x, y, z = (f"{'-' if s < 0 else '+'}{AXES[k]}" for s, k in zip(sign, chosen, strict=True))
    off = np.rad2deg(np.arccos(np.clip(np.abs(cosine).min(), -1, 1)))
    return AxisOrder((x, y, z), float(off), bool(np.linalg.det(order) < 0))
