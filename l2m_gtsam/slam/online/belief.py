"""The filter's belief at one key pose: the vehicle's pose and its sensors' calibrations.

The update is a Kalman update and not GTSAM's: of 192 components it takes 0.6 ms, elimination
5.2 ms. It needs no inverse of the covariance, which may be singular by rounding.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import gtsam
import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import KnownSensors

POSE, SENSOR = 6, 15  # components of a pose and of a sensor's calibration
HALVINGS = 8  # of a step in the line search
ITERATIONS = 20  # limit of linearisations in an update
CLOSE = 0.01  # rad, m, or of an entry of C: smaller steps end an update
ROUNDING = 1e-10  # of a correlation
LINEAR = 12  # from this component of a sensor on (H) readings are linear


@dataclass(frozen=True)
class WhitenedMeasurement:
    """A measurement at an estimate, white with unit variance.

    Attributes
    ----------
    residual
        Shape (m,).
    jacobian
        Its derivative by the components of the belief, shape (m, P).
    """

    residual: FloatArray
    jacobian: FloatArray

    @property
    def squared(self) -> float:
        """Squared length of the residual."""
        return float(self.residual @ self.residual)


class MahalanobisDistance:
    """Distance from the mean of a Gaussian, in standard deviations.

    Parameters
    ----------
    covariance
        Shape (P, P); it may be singular by rounding.
    """

    def __init__(self, covariance: FloatArray) -> None:
        self._covariance, self._sigma = covariance, np.sqrt(np.diag(covariance))

    @cached_property
    def _factor(self) -> tuple[FloatArray, bool]:
        """Cholesky factor of the correlations: needed only where a step is long."""
        correlation = self._covariance / np.outer(self._sigma, self._sigma)
        factor, lower = cho_factor(correlation + ROUNDING * np.eye(len(correlation)))
        return np.asarray(factor), bool(lower)

    def squared(self, delta: FloatArray) -> float:
        """Return the squared distance of a difference from the mean, shape (P,)."""
        u = delta / self._sigma
        return float(u @ cho_solve(self._factor, u))


@dataclass(frozen=True)
class Belief:
    """A key pose and the sensors, with their joint covariance.

    Attributes
    ----------
    pose
        Pose of the lidar in the map.
    sensors
        Estimates of the S calibrations.
    covariance
        Of a right perturbation of the pose, rotation (rad) before translation (m), and, where they
        are variables, of (t, C row by row, H) of one sensor after the other, in m and uT; shape
        (P, P) with P = 6 or 6 + 15 S.
    """

    pose: gtsam.Pose3
    sensors: KnownSensors
    covariance: FloatArray

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of the pose, shape (6, 6)."""
        return self.covariance[:POSE, :POSE]

    @property
    def has_calibrations(self) -> bool:
        """Whether calibrations are variables."""
        return len(self.covariance) > POSE

    @property
    def calibration_covariance(self) -> FloatArray:
        """Covariances of the sensors, shape (S, 15, 15); as given where they are constants."""
        if not self.has_calibrations:
            return self.sensors.covariance
        at = POSE + SENSOR * np.arange(len(self.sensors.names))[:, None] + np.arange(SENSOR)
        return np.asarray(self.covariance[at[:, :, None], at[:, None, :]])

    @property
    def known_sensors(self) -> KnownSensors:
        """The sensors with the covariances that they have by now."""
        return replace(self.sensors, covariance=self.calibration_covariance)

    def predicted(self, step: gtsam.Pose3, covariance: FloatArray) -> "PredictedBelief":
        """Return the joint belief of this key pose and the step to the next.

        Parameters
        ----------
        step
            The next key pose in the frame of this one, by odometry.
        covariance
            Of a right perturbation of it, shape (6, 6).
        """
        joint = block_diag(self.covariance, covariance)
        return PredictedBelief(self.pose, self.sensors, joint, step)

    def updated(self, measure: Callable[[Self], WhitenedMeasurement]) -> Self:
        """Return the posterior of a measurement, by an iterated Kalman update.

        Each iteration is a Gauss-Newton step of the maximum a posteriori problem (B. Bell,
        F. Cathey, IEEE Trans. Automatic Control 38, 1993, 294-297). A step that increases the
        cost is halved: near a source a field is so curved that the full step diverges.

        Parameters
        ----------
        measure
            Linearises the measurement at a belief.
        """
        P, delta, measured = self.covariance, np.zeros(len(self.covariance)), measure(self)
        component, distance = np.arange(len(P)) - POSE, MahalanobisDistance(P)
        bends = (component < 0) | (component % SENSOR < LINEAR)
        for _ in range(ITERATIONS):
            # Linearised at delta: the innovation from the prior mean is the residual less J delta.
            gain = kalman_gain(P, measured.jacobian)
            step = gain @ (measured.jacobian @ delta - measured.residual) - delta
            if np.abs(step[bends]).max() < CLOSE:
                return self._posterior(delta + step, gain, measured)
            before = distance.squared(delta) + measured.squared
            for shorter in step * 0.5 ** np.arange(HALVINGS)[:, None]:
                there = measure(self.moved(delta + shorter))
                if distance.squared(delta + shorter) + there.squared <= before:
                    break
            else:
                break
            delta, measured = delta + shorter, there
        return self._posterior(delta, kalman_gain(P, measured.jacobian), measured)

    def _posterior(
        self, delta: FloatArray, gain: FloatArray, measured: WhitenedMeasurement
    ) -> Self:
        left = self.covariance - gain @ (measured.jacobian @ self.covariance)
        return replace(self.moved(delta), covariance=left)

    def is_near(self, other: "Belief", most: float) -> bool:
        """Return whether poses (rad, m), positions of sensors (m) and C agree to ``most``."""
        parts = [other.pose.localCoordinates(self.pose), self.sensors.t - other.sensors.t]
        parts.append((self.sensors.distortion - other.sensors.distortion)[:, :9])
        return all(float(np.abs(part).max(initial=0.0)) <= most for part in parts)

    def moved(self, delta: FloatArray) -> Self:
        """Return the belief with its mean moved by a step in the components of the covariance."""
        sensors = self.sensors
        if len(delta) > POSE:
            by = delta[POSE:].reshape(-1, SENSOR)
            sensors = replace(
                sensors, t=sensors.t + by[:, :3], distortion=sensors.distortion + by[:, 3:]
            )
        return replace(self, pose=self.pose.retract(delta[:POSE]), sensors=sensors)


@dataclass(frozen=True)
class PredictedBelief(Belief):
    """The joint belief of a key pose, the sensors and the step to the next key pose.

    Attributes
    ----------
    pose, sensors
        The previous key pose in the map, and the sensors.
    covariance
        Of a belief's components and, as the last six, of a right perturbation of the step.
    step
        The next key pose in the frame of the previous.
    """

    step: gtsam.Pose3

    @property
    def has_calibrations(self) -> bool:
        """Whether calibrations are variables."""
        return len(self.covariance) > 2 * POSE

    def moved(self, delta: FloatArray) -> Self:
        """Return the belief with its mean moved by a step in the components of the covariance."""
        return replace(super().moved(delta[:-POSE]), step=self.step.retract(delta[-POSE:]))

    def marginalize_previous(self) -> Belief:
        """Return the belief of the next key pose, the previous one marginalised out."""
        # X' = X S: Exp(x') = Exp(Ad_{S^-1} x + s) to first order, for right perturbations; sensors
        # stay as they are.
        P, turn = self.covariance, self.step.inverse().AdjointMap()
        rows, after = turn @ P[:POSE] + P[-POSE:], P[:-POSE, :-POSE].copy()
        after[:POSE] = rows[:, :-POSE]
        after[:, :POSE] = after[:POSE].T
        after[:POSE, :POSE] = rows[:, :POSE] @ turn.T + rows[:, -POSE:]
        return Belief(self.pose.compose(self.step), self.sensors, after)


def kalman_gain(P: FloatArray, J: FloatArray) -> FloatArray:
    """Return the Kalman gain of a white measurement of unit variance, shape (P, m)."""
    crossed = P @ J.T
    return np.asarray(cho_solve(cho_factor(J @ crossed + np.eye(len(J))), crossed.T).T)
