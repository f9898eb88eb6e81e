"""A Kalman filter of pose, field and distortion, step by step, in an unknown field.

From odometry that has drifted by more than the field's length a smoother ends in one of many
minima. The filter comes back to a place with the drift since it was there last, and corrects it
before the next return. It is no graph of GTSAM's: each step would eliminate all weights anew.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import KeyPoseReadings, skew
from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.map_prediction import PlacedReadings, place_readings, predict
from l2m_gtsam.slam.odometry import FixedStep
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.unknown_field.tiled_drive import FieldWithWeights
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

DISTORTION = 12
NO_DRIFT = np.zeros((POSE, DRIFT))


@dataclass(frozen=True)
class FilterStep:
    """A step of odometry, and the readings on its way.

    Attributes
    ----------
    motion
        The key pose at its end in the frame of the one before.
    covariance
        Of a right perturbation of it, shape (6, 6).
    readings
        n readings relative to its end, so that they correct the pose that is known then.
    steady
        What a unit of each component of a steady drift adds along the axes of the field's frame,
        a turn about one axis (rad) before the way (m), shape (6, 8).
    fixed
        The step along fixed axes, where odometry knows it so.
    """

    motion: gtsam.Pose3
    covariance: FloatArray
    readings: KeyPoseReadings
    steady: FloatArray
    fixed: FixedStep | None = None


@dataclass(frozen=True)
class FilterState:
    """What a filter knows at a key pose.

    Attributes
    ----------
    pose
        In the frame of the field.
    weights
        Of the field, shape (m,).
    distortion
        C row by row and H of the sensors, shape (S, 12).
    steady
        Drift in standard deviations, shape (8,).
    covariance
        Of a right perturbation of the pose, weights, distortion and drift.
    log_likelihood
        Of all readings, each given those before it, but for constants: poses, field and distortion
        are integrated out.
    """

    pose: gtsam.Pose3
    weights: FloatArray
    distortion: FloatArray
    steady: FloatArray
    covariance: FloatArray
    log_likelihood: float

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of the pose, shape (6, 6)."""
        return self.covariance[:POSE, :POSE]


class FieldFilter:
    """Follows key poses in one field.

    Parameters
    ----------
    field
        In the frame of the first key pose.
    sensors
        S calibrations; their distortion is estimated, their places are taken as given.
    largest
        Squared Mahalanobis length beyond which a reading does not count.
    """

    def __init__(self, field: WholeField, sensors: KnownSensors, largest: float) -> None:
        self._field, self._sensors, self._largest = field, sensors, largest
        self._own = POSE + len(field)
        self._drift = self._own + DISTORTION * len(sensors.names)

    def start(self) -> FilterState:
        """Return what is known at the first key pose, which is given."""
        P = np.eye(self._drift + DRIFT)
        P[:POSE, :POSE] = 0.0
        for i, covariance in enumerate(self._sensors.covariance):
            begin = self._own + DISTORTION * i
            at = slice(begin, begin + DISTORTION)
            P[at, at] = covariance[3:, 3:]
        weights, distortion = np.zeros(len(self._field)), self._sensors.distortion
        return FilterState(gtsam.Pose3(), weights, distortion, np.zeros(DRIFT), P, 0.0)

    def after(self, state: FilterState, step: FilterStep) -> FilterState:
        """Return what is known at the end of a step, with its readings."""
        pose, F, by_drift = moved(step, state.pose, state.steady)
        P, drift = state.covariance.copy(), self._drift
        P[:POSE] = F @ P[:POSE] + by_drift @ P[drift:]
        P[:, :POSE] = P[:, :POSE] @ F.T + P[:, drift:] @ by_drift.T
        P[:POSE, :POSE] += step.covariance
        here = replace(state, pose=pose, covariance=P)
        if not len(step.readings):
            return here
        residual, H, volume = self._linearised(here, step.readings)
        change, P, likely = _updated(P, H, residual, self._largest)
        return FilterState(
            pose.retract(change[:POSE]),
            state.weights + change[POSE : self._own],
            state.distortion + change[self._own : drift].reshape(-1, DISTORTION),
            state.steady + change[drift:],
            P,
            state.log_likelihood + likely + volume,
        )

    def _linearised(
        self, state: FilterState, readings: KeyPoseReadings
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return whitened residuals, their derivatives, and the log determinant of the whitening.

        The readings count one and the same key pose, whatever its number.
        """
        field, known = self._field, replace(self._sensors, distortion=state.distortion)
        where = place_readings(readings, {int(readings.key_pose[0]): state.pose}, known)
        predicted = predict(FieldWithWeights(field, state.weights), where, known)
        turned = where.C @ where.readings.R_map_lidar.transpose(0, 2, 1)
        features = field.features(where.x)
        lever = carried_back(readings.R_key_lidar, readings.p_key_lidar)
        H = np.concatenate(
            [
                predicted.by_lidar @ lever,
                turned @ features,
                by_distortion(where, features @ state.weights, len(known.names)),
                np.zeros((len(readings), 3, DRIFT)),
            ],
            axis=2,
        )
        W = predicted.whitening(known.noise)
        residual = np.einsum("nij,nj->ni", W, predicted.residual)
        return residual, W @ H, float(np.linalg.slogdet(W)[1].sum())


def by_distortion(where: PlacedReadings, B: FloatArray, count: int) -> FloatArray:
    """Return the derivatives of n residuals by C row by row and H of all sensors, (n, 3, 12 S).

    The field B at the readings is in uT, shape (n, 3).
    """
    at, n = where.readings, len(where.x)
    b = np.einsum("nji,nj->ni", at.R_map_lidar, B)
    found = np.zeros((n, 3, count, DISTORTION))
    for axis in range(3):
        found[np.arange(n), axis, at.sensor, 3 * axis : 3 * axis + 3] = b
        found[np.arange(n), axis, at.sensor, 9 + axis] = 1.0
    return found.reshape(n, 3, -1)


@dataclass(frozen=True)
class DeadReckoning:
    """A pose by odometry alone, less a steady drift.

    Attributes
    ----------
    pose
        In the frame of the first key pose.
    walk
        Covariance of a right perturbation by errors of single steps, shape (6, 6).
    by_drift
        Derivative of it by the drift, shape (6, 8).
    drift
        In its standard deviations, shape (8,).
    """

    pose: gtsam.Pose3
    walk: FloatArray
    by_drift: FloatArray
    drift: FloatArray

    @classmethod
    def at_start(cls, drift: FloatArray | None = None) -> "DeadReckoning":
        """Return the first key pose, which is exact, for no drift or for a given one."""
        drift = np.zeros(DRIFT) if drift is None else drift
        return cls(gtsam.Pose3(), np.zeros((POSE, POSE)), np.zeros((POSE, DRIFT)), drift)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of a right perturbation, shape (6, 6)."""
        return np.asarray(self.walk + self.by_drift @ self.by_drift.T)

    def after(self, step: FilterStep) -> "DeadReckoning":
        """Return the pose after a step."""
        pose, F, by_drift = moved(step, self.pose, self.drift)
        walk = F @ self.walk @ F.T + step.covariance
        return DeadReckoning(pose, walk, F @ self.by_drift + by_drift, self.drift)

    def squared_distance(self, pose: gtsam.Pose3) -> float:
        """Return that of a pose in sigmas of all errors of odometry; six are expected.

        Where a turning drift has bent the path, this is linear about the drift of this one.
        """
        away = gtsam.Pose3.Logmap(self.pose.between(pose)) + self.by_drift @ self.drift
        return float(away @ np.linalg.solve(self.covariance, away))


def moved(
    step: FilterStep, pose: gtsam.Pose3, steady: FloatArray
) -> tuple[gtsam.Pose3, FloatArray, FloatArray]:
    """Return a pose after a step, and its derivatives by the one before and by a steady drift.

    Those by the pose are of right perturbations.
    """
    turned, drift = np.split(step.steady @ steady, 2)
    before, back = pose.rotation(), gtsam.Rot3.Expmap(-turned)
    if step.fixed is None:
        R, way = step.motion.rotation(), step.motion.translation()
        axes, shift = before.compose(R), before.rotate(way)
        by_turn = np.vstack([R.matrix().T, -skew(way[None])[0]])
    else:
        axes, shift = gtsam.Rot3(step.fixed.turn).compose(before), step.fixed.shift
        by_turn = np.vstack([np.eye(3), np.zeros((3, 3))])
    after = gtsam.Pose3(back.compose(axes), pose.translation() + shift - drift)
    F = np.hstack([by_turn, np.vstack([np.zeros((3, 3)), np.eye(3)])])
    F[3:] = after.rotation().between(before).matrix() @ F[3:]
    by_drift = -np.kron(np.eye(2), after.rotation().matrix().T) @ step.steady
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
