"""A Kalman filter of pose and field along a drive: where the smoother starts.

From odometry that has drifted by more than the field's length the smoother ends in one of many
minima. The filter comes back to a place with the drift since it was there last, and corrects it
before the next return.
"""

from dataclasses import replace

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import PlacedReadings, place_readings, predict
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.relative_motion import from_end
from l2m_gtsam.slam.unknown_field.tiled_drive import FieldWithWeights
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

DISTORTION = 12


def filtered_poses(
    drive: Drive, field: WholeField, origin: gtsam.Pose3, largest: float
) -> list[gtsam.Pose3]:
    """Return the K key poses, each by the readings until then.

    Parameters
    ----------
    drive
        Odometry and readings.
    field
        In the frame of the first key pose.
    origin
        The first key pose.
    largest
        Squared Mahalanobis length beyond which a reading does not count.
    """
    steps, sensors = drive.steps, drive.sensors
    key = drive.readings.key_pose
    # Relative to the ends of steps, so that a reading corrects the pose that is known then.
    readings = from_end(drive.readings, steps.R[key], steps.p[key])
    lever = carried_back(readings.R_key_lidar, readings.p_key_lidar)
    bounds = np.searchsorted(key, np.arange(len(steps) + 1))
    pose, found = gtsam.Pose3(), [gtsam.Pose3()]
    count, own = len(sensors.names), POSE + len(field)
    weights, P = np.zeros(len(field)), np.eye(own + DISTORTION * count)
    P[:POSE, :POSE] = 0.0
    for i, covariance in enumerate(sensors.covariance):
        at = slice(own + DISTORTION * i, own + DISTORTION * (i + 1))
        P[at, at] = covariance[3:, 3:]
    for k in range(len(steps)):
        pose, F = _moved(drive, k, pose)
        P[:POSE] = F @ P[:POSE]
        P[:, :POSE] = P[:, :POSE] @ F.T
        P[:POSE, :POSE] += steps.covariance[k]
        rows = np.arange(bounds[k], bounds[k + 1])
        if len(rows):
            where = place_readings(readings[rows], {k: pose}, sensors)
            predicted = predict(FieldWithWeights(field, weights), where, sensors)
            turned = where.C @ where.readings.R_map_lidar.transpose(0, 2, 1)
            H = np.concatenate(
                [
                    predicted.by_lidar @ lever[rows],
                    turned @ field.features(where.x),
                    by_distortion(where, weights, field, count),
                ],
                axis=2,
            )
            W = predicted.whitening(sensors.noise)
            change, P = _updated(P, W @ H, np.einsum("nij,nj->ni", W, predicted.residual), largest)
            pose = pose.retract(change[:POSE])
            weights = weights + change[POSE:own]
            distortion = sensors.distortion + change[own:].reshape(count, DISTORTION)
            sensors = replace(sensors, distortion=distortion)
        found.append(pose)
    return [origin.compose(each) for each in found]


def by_distortion(
    where: PlacedReadings, weights: FloatArray, field: WholeField, count: int
) -> FloatArray:
    """Return the derivatives of n residuals by C row by row and H of all sensors, (n, 3, 12 S)."""
    at, n = where.readings, len(where.x)
    B = field.features(where.x) @ weights
    b = np.einsum("nji,nj->ni", at.R_map_lidar, B)
    found = np.zeros((n, 3, count, DISTORTION))
    for axis in range(3):
        found[np.arange(n), axis, at.sensor, 3 * axis : 3 * axis + 3] = b
        found[np.arange(n), axis, at.sensor, 9 + axis] = 1.0
    return found.reshape(n, 3, -1)


def _moved(drive: Drive, number: int, pose: gtsam.Pose3) -> tuple[gtsam.Pose3, FloatArray]:
    """Return a pose after a step, and the derivative by a right perturbation of the one before."""
    step = drive.step(number)
    if drive.steps.fixed_axes is None:
        return pose.compose(step), step.inverse().AdjointMap()
    turn, F = step.rotation(), np.zeros((POSE, POSE))
    F[:3, :3] = F[3:, 3:] = turn.matrix().T
    way = pose.translation() + drive.steps.fixed_axes[number]
    return gtsam.Pose3(pose.rotation().compose(turn), way), F


def _updated(
    P: FloatArray, H: FloatArray, residual: FloatArray, largest: float
) -> tuple[FloatArray, FloatArray]:
    """Return the change of the mean by whitened residuals (n, 3), and the covariance after it."""
    PH = P @ H.transpose(0, 2, 1)
    own = H @ PH + np.eye(3)
    squared = np.einsum("ni,ni->n", residual, np.linalg.solve(own, residual[:, :, None])[:, :, 0])
    near = squared <= largest
    if not near.any():
        return np.zeros(len(P)), P
    A, e = H[near].reshape(-1, len(P)), residual[near].ravel()
    AP = A @ P
    S = AP @ A.T + np.eye(len(e))
    K = np.linalg.solve(S, AP)
    P = P - AP.T @ K
    return -K.T @ e, 0.5 * (P + P.T)
