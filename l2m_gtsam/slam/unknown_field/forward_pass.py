"""A Kalman filter of pose and field along a drive: where the smoother starts.

From odometry that has drifted by more than the field's length the smoother ends in one of many
minima. The filter comes back to a place with the drift since it was there last, and corrects it
before the next return.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import drift_weights, skew
from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import PlacedReadings, place_readings, predict
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.relative_motion import from_end
from l2m_gtsam.slam.unknown_field.tiled_drive import FieldWithWeights
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

DISTORTION = 12


@dataclass(frozen=True)
class FollowedDrive:
    """A drive that was followed.

    Attributes
    ----------
    poses
        K key poses, each by the readings until then.
    log_likelihood
        Of all readings, each given those before it, but for constants: poses, field and distortion
        are integrated out.
    """

    poses: list[gtsam.Pose3]
    log_likelihood: float


def followed(drive: Drive, field: WholeField, origin: gtsam.Pose3, largest: float) -> FollowedDrive:
    """Follow a drive.

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
    pose, found, log_likelihood = gtsam.Pose3(), [gtsam.Pose3()], 0.0
    count, own = len(sensors.names), POSE + len(field)
    drift = own + DISTORTION * count
    steady = np.zeros(POSE)  # in standard deviations, with time and with distance
    weights, P = np.zeros(len(field)), np.eye(drift + POSE)
    P[:POSE, :POSE] = 0.0
    for i, covariance in enumerate(sensors.covariance):
        at = slice(own + DISTORTION * i, own + DISTORTION * (i + 1))
        P[at, at] = covariance[3:, 3:]
    for k in range(len(steps)):
        pose, F, by_drift = _moved(drive, k, pose, steady)
        P[:POSE] = F @ P[:POSE] + by_drift @ P[drift:]
        P[:, :POSE] = P[:, :POSE] @ F.T + P[:, drift:] @ by_drift.T
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
                    np.zeros((len(rows), 3, POSE)),
                ],
                axis=2,
            )
            W = predicted.whitening(sensors.noise)
            residual = np.einsum("nij,nj->ni", W, predicted.residual)
            change, P, likely = _updated(P, W @ H, residual, largest)
            log_likelihood += likely + np.linalg.slogdet(W)[1].sum()
            pose = pose.retract(change[:POSE])
            weights = weights + change[POSE:own]
            steady = steady + change[drift:]
            distortion = sensors.distortion + change[own:drift].reshape(count, DISTORTION)
            sensors = replace(sensors, distortion=distortion)
        found.append(pose)
    return FollowedDrive([origin.compose(each) for each in found], float(log_likelihood))


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


def _moved(
    drive: Drive, number: int, pose: gtsam.Pose3, steady: FloatArray
) -> tuple[gtsam.Pose3, FloatArray, FloatArray]:
    """Return a pose after a step, and its derivatives by the one before and by a steady drift.

    Those by the pose are of right perturbations.
    """
    steps, step = drive.steps, drive.step(number)
    weights = np.zeros(2) if steps.steady is None else steps.steady[number]
    W = drift_weights(weights)
    F, by_drift = np.zeros((POSE, POSE)), np.zeros((POSE, POSE))
    if steps.fixed_axes is None:
        drift = pose.rotation().matrix().T @ W @ steady
        step = gtsam.Pose3(step.rotation(), step.translation() - drift)
        after, F = pose.compose(step), step.inverse().AdjointMap()
        F[3:, :3] -= step.rotation().matrix().T @ skew(drift[None])[0]
    else:
        turn = gtsam.Rot3(steps.fixed_turns[number])
        place = pose.translation() + steps.fixed_axes[number] - W @ steady
        after = gtsam.Pose3(turn.compose(pose.rotation()), place)
        F[:3, :3] = np.eye(3)
        F[3:, 3:] = after.rotation().between(pose.rotation()).matrix()
    by_drift[3:] = -after.rotation().matrix().T @ W
    return after, F, by_drift


def _updated(
    P: FloatArray, H: FloatArray, residual: FloatArray, largest: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the change of the mean by residuals (n, 3), the covariance after it, their density.

    Residuals are whitened. Those that do not count are as likely as the least that do.
    """
    PH = P @ H.transpose(0, 2, 1)
    own = H @ PH + np.eye(3)
    squared = np.einsum("ni,ni->n", residual, np.linalg.solve(own, residual[:, :, None])[:, :, 0])
    near = squared <= largest
    likely = -0.5 * float(np.sum(largest + np.linalg.slogdet(own[~near])[1]))
    if not near.any():
        return np.zeros(len(P)), P, likely
    A, e = H[near].reshape(-1, len(P)), residual[near].ravel()
    AP = A @ P
    S = AP @ A.T + np.eye(len(e))
    K = np.linalg.solve(S, AP)
    P = P - AP.T @ K
    likely -= 0.5 * float(e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1])
    return -K.T @ e, 0.5 * (P + P.T), likely
