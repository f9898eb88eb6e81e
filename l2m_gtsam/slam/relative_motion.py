"""The ways between key poses: where readings on them stand, and what odometry's errors do to them.

Odometry errs as a random walk does: after a share s of a step by ``s Q`` of its covariance Q, in
new directions all the time. Where both ends of the step are estimated, a reading between them is
shifted by s of what was found for the whole step, and what is left is a Brownian bridge: the ways
to two readings after shares s <= s' err together by ``s (1 - s') Q``. Both hold to first order in
the error, with Q along the axes of the step's end.

A step in which odometry jumped is one between two of its poses, with a Q of its own (see
``jumps``): nothing tells when within it, and the bridge is widest in its middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import KeyPoseReadings, StepError, Whitening, rotation_matrices
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.solve.linear_algebra import covariance_root
from l2m_gtsam.solve.noise import whitening

INSTANTS = 15  # within a step that are told from each other, evenly over it where there are more


@dataclass(frozen=True)
class RelativeMotions:
    """The ways of a drive at an estimate of its key poses.

    Attributes
    ----------
    readings
        N readings, shifted on their ways as the estimate asks for.
    steps
        From each key pose to the next, as estimated.
    covariance
        Of the errors of odometry's steps, shape (K - 1, 6, 6).
    by_step
        What a perturbation of the end of its step does to the lidar at a reading that were rigidly
        fixed to it, shape (N, 6, 6).
    """

    readings: KeyPoseReadings
    steps: tuple[gtsam.Pose3, ...]
    covariance: FloatArray
    by_step: FloatArray

    @classmethod
    def along(cls, drive: Drive, poses: Sequence[gtsam.Pose3]) -> "RelativeMotions":
        """Return those of a drive whose K key poses are taken for these."""
        steps = tuple(a.between(b) for a, b in pairwise(poses))
        rows, key = np.arange(len(drive.readings)), drive.readings.key_pose
        shifted = interpolated_readings(drive, rows, [steps[k] for k in key.tolist()])
        end = from_end(drive.readings, drive.steps.R[key], drive.steps.p[key])
        by_step = carried_back(end.R_key_lidar, end.p_key_lidar)
        return cls(shifted, steps, drive.steps.covariance, by_step)

    def share(self, rows: IntArray, by_lidar: FloatArray) -> FloatArray:
        """Return what is left of odometry's errors in n residuals, uT^2, shape (n, 3, 3).

        Parameters
        ----------
        rows
            Of the readings.
        by_lidar
            Derivatives of their residuals by a right perturbation of the lidar's pose, (n, 3, 6).
        """
        s, F = self.readings.fraction[rows], by_lidar @ self.by_step[rows]
        Q = self.covariance[self.readings.key_pose[rows]]
        return np.asarray((s * (1 - s))[:, None, None] * (F @ Q @ F.transpose(0, 2, 1)))

    def whitening(self, rows: IntArray, own: FloatArray, by_lidar: FloatArray) -> Whitening:
        """Return what makes the residuals of n readings on one key pose white.

        Parameters
        ----------
        rows, by_lidar
            As of ``share``.
        own
            For the noise of each reading alone, 1/uT, shape (n, 3, 3).
        """
        F, Q = by_lidar @ self.by_step[rows], self.covariance[self.readings.key_pose[rows[0]]]
        return bridge_whitening(own, F, self.readings.fraction[rows], Q)

    def step_error(self, rows: IntArray, by_lidar: FloatArray) -> StepError:
        """Return what n readings on one key pose feel of the step; parameters as of ``share``."""
        key_pose = int(self.readings.key_pose[rows[0]])
        slope = self.readings.fraction[rows, None, None] * (by_lidar @ self.by_step[rows])
        return StepError(key_pose, self.steps[key_pose], slope)


def interpolated_readings(
    drive: Drive, rows: IntArray, steps: Sequence[gtsam.Pose3]
) -> KeyPoseReadings:
    """Return n readings of a drive as they hang if the step of each is this and not odometry's."""
    if not len(rows):
        return drive.readings[rows]
    R = np.stack([each.rotation().matrix() for each in steps])
    p = np.stack([each.translation() for each in steps])
    readings = drive.readings[rows]
    R_odo, p_odo = drive.steps.R[readings.key_pose], drive.steps.p[readings.key_pose]
    turn = Rotation.from_matrix(R_odo.transpose(0, 2, 1) @ R).as_rotvec()
    return shifted_readings(readings, R_odo, p_odo, turn, p - p_odo)


def from_end(readings: KeyPoseReadings, R: FloatArray, p: FloatArray) -> KeyPoseReadings:
    """Return readings as they hang on the ends of their steps.

    Parameters
    ----------
    readings
        As odometry hangs them on the key poses before them, n in number.
    R, p
        The step by odometry of each, or one for all, shapes (..., 3, 3) and (..., 3), metres.
    """
    back = R.swapaxes(-1, -2)
    off = (back @ (readings.p_key_lidar - p)[:, :, None])[:, :, 0]
    return replace(readings, R_key_lidar=back @ readings.R_key_lidar, p_key_lidar=off)


def shifted_readings(
    readings: KeyPoseReadings, R: FloatArray, p: FloatArray, turn: FloatArray, shift: FloatArray
) -> KeyPoseReadings:
    """Return readings shifted by their shares of what changes a step.

    Parameters
    ----------
    readings, R, p
        As of ``from_end``.
    turn
        By what vector the end of the step is turned, about its axes, rad, shape (..., 3).
    shift
        By what it is shifted, along the axes of the key pose, metres, shape (..., 3).
    """
    s, end = readings.fraction[:, None], from_end(readings, R, p)
    # The end of the step with a share of the change, and from there on as odometry has it.
    R_end, p_end = R @ rotation_matrices(s * turn), p + s * shift
    way = (R_end @ end.p_key_lidar[:, :, None])[:, :, 0]
    return replace(readings, R_key_lidar=R_end @ end.R_key_lidar, p_key_lidar=way + p_end)


def bridge_whitening(own: FloatArray, F: FloatArray, s: FloatArray, Q: FloatArray) -> Whitening:
    """Return what makes the residuals of n readings within one step white.

    Parameters
    ----------
    own
        For the noise of each reading alone, 1/uT, shape (n, 3, 3).
    F
        Derivatives of residuals by a perturbation of the end of the step, shape (n, 3, 6).
    s
        Shares of the step that lie behind them, shape (n,).
    Q
        Covariance of the step, shape (6, 6).
    """
    at, F = _instants(s), F @ np.linalg.cholesky(Q)
    slot = np.abs(np.subtract.outer(s, at)).argmin(axis=1)
    bridge = np.minimum.outer(at, at) - np.outer(at, at)
    errors = np.einsum("nij,nm->nimj", F, covariance_root(bridge)[slot])
    # From the instant to the reading it is a way of its own, as far as others know.
    rest = own @ F * np.sqrt(np.abs(s - at[slot]))[:, None, None]
    own = whitening(np.eye(3) + rest @ rest.transpose(0, 2, 1)) @ own
    return Whitening.with_errors(own, errors.reshape(*own.shape[:2], -1))


def _instants(s: FloatArray) -> FloatArray:
    """Return shares of a step that stand for these, n of them, ascending."""
    at = np.unique(s)
    return at if len(at) <= INSTANTS else np.unique(np.round((INSTANTS + 1) * s)) / (INSTANTS + 1)
