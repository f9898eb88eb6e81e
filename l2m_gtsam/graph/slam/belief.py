"""What is known of the vehicle at one key pose: where it is, and how its sensors read."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from l2m_gtsam.data import FloatArray
from l2m_gtsam.graph.slam.drive import KnownSensors

POSE, SENSOR = 6, 15  # components of a pose and of a sensor's calibration
HALVINGS = 8  # of a step
ITERATIONS = 20  # the most linearisations of what is seen
CLOSE = 0.01  # rad, m, or of an entry of C: what moved by less need not be linearised anew
ROUNDING = 1e-10  # of a correlation
LINEAR = 12  # the first component of a sensor that readings are linear in


@dataclass(frozen=True)
class Evidence:
    """What is seen at an estimate.

    Attributes
    ----------
    residual
        Whitened, shape (m,).
    jacobian
        Its derivative by the components of the belief, shape (m, P).
    """

    residual: FloatArray
    jacobian: FloatArray


@dataclass(frozen=True)
class Belief:
    """A key pose and the sensors, with their joint covariance.

    Attributes
    ----------
    pose
        Of the lidar in the map.
    sensors
        Calibrations as they are known by then.
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
        """That of the pose, shape (6, 6)."""
        return self.covariance[:POSE, :POSE]

    @property
    def calibration_covariance(self) -> FloatArray:
        """Those of the sensors, shape (S, 15, 15); as they were given where they are constants."""
        if len(self.covariance) == POSE:
            return self.sensors.covariance
        at = POSE + SENSOR * np.arange(len(self.sensors.names))[:, None] + np.arange(SENSOR)
        return np.asarray(self.covariance[at[:, :, None], at[:, None, :]])

    def after(self, step: gtsam.Pose3, covariance: FloatArray) -> "Belief":
        """Return what is known of the next key pose by odometry, whose covariance is (6, 6)."""
        moved, back = self.covariance.copy(), step.inverse().AdjointMap()
        moved[:POSE] = back @ moved[:POSE]
        moved[:, :POSE] = moved[:, :POSE] @ back.T
        moved[:POSE, :POSE] += covariance
        return Belief(self.pose.compose(step), self.sensors, moved)

    def corrected(self, seen: Callable[["Belief"], Evidence]) -> "Belief":
        """Return what is known once something was seen, by an iterated Kalman update.

        A step that makes the squared residuals and the distance from this belief larger together
        is halved: near a source a field bends so much that a whole one would lead away.
        """
        P, delta = self.covariance, np.zeros(len(self.covariance))
        component = np.arange(len(P)) - POSE
        bends = (component < 0) | (component % SENSOR < LINEAR)
        found, solve = seen(self), None
        for _ in range(ITERATIONS):
            gain = gain_of(P, found.jacobian)
            step = gain @ (found.jacobian @ delta - found.residual) - delta
            if np.abs(step[bends]).max() < CLOSE:
                delta = delta + step
                break
            solve = solve or inverse_of(P)
            before = cost(found, delta, solve)
            for _ in range(HALVINGS):
                beyond = seen(self.moved(delta + step))
                if cost(beyond, delta + step, solve) <= before:
                    break
                step = 0.5 * step
            delta, found = delta + step, beyond
        gain = gain_of(P, found.jacobian)
        return replace(self.moved(delta), covariance=P - gain @ found.jacobian @ P)

    def moved(self, delta: FloatArray) -> "Belief":
        """Return the belief elsewhere, by components as those of the covariance."""
        sensors = self.sensors
        if len(delta) > POSE:
            by = delta[POSE:].reshape(-1, SENSOR)
            sensors = replace(
                sensors, t=sensors.t + by[:, :3], distortion=sensors.distortion + by[:, 3:]
            )
        return Belief(self.pose.retract(delta[:POSE]), sensors, self.covariance)


def gain_of(P: FloatArray, J: FloatArray) -> FloatArray:
    """Return Kalman's gain for white evidence of unit variance, shape (P, m)."""
    crossed = P @ J.T
    return np.asarray(cho_solve(cho_factor(J @ crossed + np.eye(len(J))), crossed.T).T)


def inverse_of(P: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what multiplies by the inverse of a covariance, rounding allowed for."""
    sigma = np.sqrt(np.diag(P))
    factor = cho_factor(P / np.outer(sigma, sigma) + ROUNDING * np.eye(len(P)))
    return lambda delta: np.asarray(cho_solve(factor, delta / sigma) / sigma)


def cost(found: Evidence, delta: FloatArray, solve: Callable[[FloatArray], FloatArray]) -> float:
    """Return the squared distance from a belief and from what is seen, in sigmas."""
    return float(delta @ solve(delta) + found.residual @ found.residual)
