"""Magnetic readings on any ``Pose3`` of any graph, whatever its key: for pose graphs of others."""

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import indices, noise_of
from l2m_factors.field_map import DifferentiableMap, FloatArray, Jacobians
from l2m_factors.key_pose_readings import Calibrations, KeyPoseReadings, key_pose_residuals


def magnetic_pose_factor(
    key: int,
    field_map: DifferentiableMap,
    sensors: Calibrations,
    sensor: npt.NDArray[np.int64],
    field: FloatArray,
    noise: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:
    """Return one factor of readings that were taken at a pose, with known calibrations.

    It may be the pose of anything: sensors are placed in its frame, whatever ``t`` they have there.

    Parameters
    ----------
    key
        Of the pose in the frame of the map: Pose3, metres.
    field_map
        The map.
    sensors
        Calibrations of the sensors, in the frame of the pose.
    sensor, field
        Index of the sensor of each reading, and what it read in uT, shapes (n,) and (n, 3).
    noise
        Of the n readings one after the other, 3n components in uT.

    Raises
    ------
    ValueError
        An array or the noise has another shape, a sensor no calibration, or a number is not finite:
        leave such a reading out. The line names it.
    """
    sensor = indices("sensor", sensor)
    n = len(sensor)
    here = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    at = KeyPoseReadings(np.zeros(n, dtype=np.int64), sensor, *here, np.zeros(n), field)
    readings, known = at.checked(), sensors.checked(sensor)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        pose = values.atPose3(key)
        R = np.tile(pose.rotation().matrix(), (n, 1, 1))
        p = np.tile(pose.translation(), (n, 1))
        residuals = key_pose_residuals(readings, field_map, R, p, known)
        if jacobians is not None:
            jacobians[0] = residuals.de_dX.reshape(3 * n, 6)
        return residuals.reading.residual.ravel()

    return gtsam.CustomFactor(noise_of(noise, 3 * n), [key], error)
