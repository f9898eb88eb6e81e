"""Relative motions between key poses: interpolated readings, and what odometry's errors do to them.

Odometry's error is a random walk: after a share s of a step it has the covariance ``s Q``, with
independent increments. Where both ends of the step are estimated, a reading between them is shifted
by s of the correction of the whole step, and what remains is a Brownian bridge: the errors at two
readings after shares s <= s' have the covariance ``s (1 - s') Q``. Both hold to first order in the
error, with Q along the axes of the step's end (T. Barfoot, C. Tong, S. Sarkka, RSS 2014, has the
general case).

A step in which odometry jumped has a Q of its own (see ``recording.odometry_jumps``): the time of
the jump within it is unknown, and the bridge is widest in its middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import KeyPoseReadings, StepError, Whitening, rotation_matrices
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drive import Drive, stacked
from l2m_gtsam.slam.map_prediction import MapPrediction
from l2m_gtsam.slam.odometry import OdometrySteps
from l2m_gtsam.solve.linear_algebra import covariance_root
from l2m_gtsam.solve.noise import whitening

INSTANTS = 15  # limit of distinct times within a step; more are rounded to so many


@dataclass(frozen=True)
class RelativeMotions:
    """The relative motions of a drive at an estimate of its key poses.

    Attributes
    ----------
    readings
        N readings relative to their key poses, corrected by the estimated steps.
    steps
        From each key pose to the next by the estimate, K - 1.
    covariance
        Of odometry's steps, shape (K - 1, 6, 6).
    by_step
        Adjoints that take a perturbation of the end of a step to the lidar at a reading, as if it
        were rigidly fixed to that end, shape (N, 6, 6).
    odometry
        The steps as odometry has them.
    """

    readings: KeyPoseReadings
    steps: tuple[gtsam.Pose3, ...]
    covariance: FloatArray
    by_step: FloatArray
    odometry: OdometrySteps

    @classmethod
    def along(cls, drive: Drive, poses: Sequence[gtsam.Pose3]) -> "RelativeMotions":
        """Return the motions of a drive at an estimate of its K key poses."""
        steps = tuple(a.between(b) for a, b in pairwise(poses))
        rows, key = np.arange(len(drive.readings)), drive.readings.key_pose
        shifted = interpolated_readings(drive, rows, [steps[k] for k in key.tolist()])
        end = from_end(drive.readings, drive.steps.R[key], drive.steps.p[key])
        by_step = carried_back(end.R_key_lidar, end.p_key_lidar)
        return cls(shifted, steps, drive.steps.covariance, by_step, drive.steps)

    def without(self, brought: FloatArray) -> "RelativeMotions":
        """Return the same without what something adds to the readings, uT, shape (N, 3)."""
        return replace(self, readings=replace(self.readings, field=self.readings.field - brought))

    def interpolation_covariance(self, rows: IntArray, by_lidar: FloatArray) -> FloatArray:
        """Return the bridge's covariance of n residuals, each alone, uT^2, shape (n, 3, 3).

        Parameters
        ----------
        rows
            Of n readings.
        by_lidar
            Derivatives of their residuals by a right perturbation of the lidar's pose, (n, 3, 6).
        """
        s, F = self.readings.fraction[rows], by_lidar @ self.by_step[rows]
        Q = self.covariance[self.readings.key_pose[rows]]
        return np.asarray((s * (1 - s))[:, None, None] * (F @ Q @ F.transpose(0, 2, 1)))

    def whitening(
        self, rows: IntArray, own: FloatArray, by_lidar: FloatArray, more: FloatArray | None = None
    ) -> Whitening:
        """Return the joint whitening of the residuals of n readings on one key pose.

        Parameters
        ----------
        rows, by_lidar
            As of ``interpolation_covariance``.
        own
            Whitening of each reading's own noise, 1/uT, shape (n, 3, 3).
        more
            What other errors add in one standard deviation of each, uT, shape (n, 3, q).
        """
        F, Q = by_lidar @ self.by_step[rows], self.covariance[self.readings.key_pose[rows[0]]]
        return bridge_whitening(own, F, self.readings.fraction[rows], Q, more)

    def step_error(self, rows: IntArray, by_lidar: FloatArray) -> StepError:
        """Return the derivatives of n readings on one key pose by the step; parameters as above."""
        key_pose = int(self.readings.key_pose[rows[0]])
        slope = self.readings.fraction[rows, None, None] * (by_lidar @ self.by_step[rows])
        return StepError(key_pose, self.steps[key_pose], slope)


@dataclass(frozen=True)
class DrivePrediction:
    """A drive's N readings at an estimate.

    Attributes
    ----------
    motions
        Relative motions between the key poses.
    prediction
        The map at the readings.
    """

    motions: RelativeMotions
    prediction: MapPrediction

    @property
    def interpolation_covariance(self) -> FloatArray:
        """Covariance of residuals by odometry's errors between key poses, uT^2, (N, 3, 3)."""
        return self.motions.interpolation_covariance(
            np.arange(len(self.prediction.inside)), self.prediction.by_lidar
        )

    def squared(self, noise: FloatArray) -> FloatArray:
        """Return squared Mahalanobis distances of the residuals, each alone, shape (N,)."""
        return self.prediction.squared(
            self.prediction.whitening(noise, extra=self.interpolation_covariance)
        )

    def independent(self, noise: FloatArray, used: BoolArray) -> FloatArray:
        """Return the same of residuals that are decorrelated within each step, shape (N,).

        Zero for readings that are not used or outside of the map.
        """
        prediction, squared = self.prediction, np.zeros(len(used))
        own = prediction.whitening(noise)
        rows = np.flatnonzero(used & prediction.inside)
        for at in by_key_pose(self.motions.readings.key_pose[rows]):
            part = rows[at]
            white = self.motions.whitening(part, own[part], prediction.by_lidar[part])
            e = white(prediction.residual[part, :, None]).reshape(-1, 3)
            squared[part] = np.einsum("ni,ni->n", e, e)
        return squared


def by_key_pose(key_pose: IntArray) -> list[IntArray]:
    """Return the rows of each key pose, one after the other, from those of n readings in order."""
    rows = np.arange(len(key_pose))
    return np.split(rows, np.flatnonzero(np.diff(key_pose)) + 1) if len(rows) else []


def interpolated_readings(
    drive: Drive, rows: IntArray, steps: Sequence[gtsam.Pose3]
) -> KeyPoseReadings:
    """Return n readings of a drive relative to their key poses, at estimates of their steps."""
    if not len(rows):
        return drive.readings[rows]
    readings, (R, p) = drive.readings[rows], stacked(steps)
    R_odo, p_odo = drive.steps.R[readings.key_pose], drive.steps.p[readings.key_pose]
    turn = Rotation.from_matrix(R_odo.transpose(0, 2, 1) @ R).as_rotvec()
    return shifted_readings(readings, R_odo, p_odo, turn, p - p_odo)


def from_end(readings: KeyPoseReadings, R: FloatArray, p: FloatArray) -> KeyPoseReadings:
    """Return readings relative to the ends of their steps.

    Parameters
    ----------
    readings
        n readings relative to the key poses before them, by odometry.
    R, p
        The step by odometry of each, or one for all, shapes (..., 3, 3) and (..., 3), metres.
    """
    back = R.swapaxes(-1, -2)
    off = (back @ (readings.p_key_lidar - p)[:, :, None])[:, :, 0]
    return replace(readings, R_key_lidar=back @ readings.R_key_lidar, p_key_lidar=off)


def shifted_readings(
    readings: KeyPoseReadings, R: FloatArray, p: FloatArray, turn: FloatArray, shift: FloatArray
) -> KeyPoseReadings:
    """Return readings corrected by their shares of a step's correction.

    Parameters
    ----------
    readings, R, p
        As of ``from_end``.
    turn
        Rotation vector of the correction, about the axes of the step's end, rad, shape (..., 3).
    shift
        Translation of the correction, along the axes of the key pose, metres, shape (..., 3).
    """
    s, end = readings.fraction[:, None], from_end(readings, R, p)
    # The end of the step with a share of the correction, and from there to the lidar by odometry.
    R_end, p_end = R @ rotation_matrices(s * turn), p + s * shift
    lever = (R_end @ end.p_key_lidar[:, :, None])[:, :, 0]
    return replace(readings, R_key_lidar=R_end @ end.R_key_lidar, p_key_lidar=lever + p_end)


def bridge_whitening(
    own: FloatArray, F: FloatArray, s: FloatArray, Q: FloatArray, more: FloatArray | None = None
) -> Whitening:
    """Return the joint whitening of the residuals of n readings within one step.

    Parameters
    ----------
    own
        Whitening of each reading's own noise, 1/uT, shape (n, 3, 3).
    F
        Derivatives of residuals by a perturbation of the end of the step, shape (n, 3, 6).
    s
        Share of the step that is done at each, shape (n,).
    Q
        Covariance of the step, shape (6, 6).
    more
        What other errors add in one standard deviation of each, uT, shape (n, 3, q).
    """
    at, F = _instants(s), F @ np.linalg.cholesky(Q)
    slot = np.abs(np.subtract.outer(s, at)).argmin(axis=1)
    bridge = np.minimum.outer(at, at) - np.outer(at, at)
    errors = np.einsum("nij,nm->nimj", F, covariance_root(bridge)[slot])
    # From the instant to the reading the walk counts as independent of other readings.
    rest = own @ F * np.sqrt(np.abs(s - at[slot]))[:, None, None]
    own = whitening(np.eye(3) + rest @ rest.transpose(0, 2, 1)) @ own
    errors = errors.reshape(*own.shape[:2], -1)
    return Whitening.with_errors(
        own, errors if more is None else np.concatenate([errors, more], axis=2)
    )


def _instants(s: FloatArray) -> FloatArray:
    """Return the shares of a step that n shares are rounded to, ascending."""
    at = np.unique(s)
    return at if len(at) <= INSTANTS else np.unique(np.round((INSTANTS + 1) * s)) / (INSTANTS + 1)
