"""Steps between poses, and the motion of their neighbours about each. Pure arrays."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, FloatArray, Trajectory

NEIGHBOURS = 3  # steps before and after, from which the motion is predicted
AXES = 3
GAP = 2.0  # times the usual time of a step


@dataclass(frozen=True)
class Steps:
    """N steps between poses.

    Attributes
    ----------
    seconds, middle
        How long each takes, and when its middle is, shape (N,).
    turn, shift
        Rotation vector in rad, and translation in m along the axes of the pose before, (N, 3).
    """

    seconds: FloatArray
    middle: FloatArray
    turn: FloatArray
    shift: FloatArray

    @property
    def period(self) -> float:
        """Usual time of a step in seconds."""
        return float(np.median(self.seconds))

    @property
    def is_gap(self) -> BoolArray:
        """Which steps are over a gap of poses, in which the body may have stopped, shape (N,)."""
        return self.seconds > GAP * self.period

    def velocity(self) -> FloatArray:
        """Return rad/s and m/s, the latter along the axes that the body has half way, (N, 6).

        On an arc these do not change, however long the steps are.
        """
        half = Rotation.from_rotvec(self.turn / 2).inv()
        return np.hstack([self.turn, half.apply(self.shift)]) / self.seconds[:, None]


def steps_of(trajectory: Trajectory) -> Steps:
    """Return the steps between poses."""
    at = 1e-9 * (trajectory.stamp_ns - trajectory.stamp_ns[0])
    R_back = trajectory.R[:-1].transpose(0, 2, 1)
    return Steps(
        seconds=np.diff(at),
        middle=(at[1:] + at[:-1]) / 2,
        turn=Rotation.from_matrix(R_back @ trajectory.R[1:]).as_rotvec(),
        shift=np.einsum("nij,nj->ni", R_back, np.diff(trajectory.p, axis=0)),
    )


@dataclass(frozen=True)
class MotionAbout:
    """The motion of good steps about each of N steps, as that of the step.

    Attributes
    ----------
    R, t
        The pose after in the frame of the pose before, (N, 3, 3) and (N, 3), metres.
    off
        What the steps differ from it by: rotation vector in rad and translation in m, (N, 6).
    away
        Time from each step to the good ones, seconds, shape (N,).
    """

    R: FloatArray
    t: FloatArray
    off: FloatArray
    away: FloatArray

    def sizes(self) -> FloatArray:
        """Return by how much steps differ in rad and m, shape (N, 2)."""
        return np.asarray(np.linalg.norm(self.off.reshape(-1, 2, AXES), axis=2))


def motion_about(steps: Steps, good: BoolArray) -> MotionAbout:
    """Return the motion of three good steps before and three after each step, shape (N,)."""
    velocity, away = _about(steps, good)
    expected = velocity * steps.seconds[:, None]
    turn = Rotation.from_rotvec(expected[:, :3])
    shift = Rotation.from_rotvec(expected[:, :3] / 2).apply(expected[:, 3:])
    off = np.hstack(
        [(turn.inv() * Rotation.from_rotvec(steps.turn)).as_rotvec(), steps.shift - shift]
    )
    off[:, 3:] = turn.inv().apply(off[:, 3:])
    return MotionAbout(turn.as_matrix(), shift, off, away)


def _about(steps: Steps, good: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the median velocity of good steps about each, (N, 6), and their time from it, (N,)."""
    rows = np.flatnonzero(good)
    before = np.searchsorted(rows, np.arange(len(good)))
    after = before + good  # a good step is no neighbour of its own
    beside = np.arange(NEIGHBOURS)
    slots = np.hstack([before[:, None] - 1 - beside, after[:, None] + beside])
    there = (slots >= 0) & (slots < len(rows))
    near = rows[np.clip(slots, 0, len(rows) - 1)]
    away = np.where(there, np.abs(steps.middle[near] - steps.middle[:, None]), np.nan)
    velocity = np.where(there[:, :, None], steps.velocity()[near], np.nan)
    return np.nanmedian(velocity, axis=1), np.nanmedian(away, axis=1)


def changes_among(steps: Steps, good: BoolArray) -> FloatArray:
    """Return how fast velocities change between good steps, rad/s^2 and m/s^2, shape (M, 2)."""
    change = np.diff(steps.velocity()[good], axis=0) / np.diff(steps.middle[good])[:, None]
    return np.asarray(np.linalg.norm(change.reshape(-1, 2, AXES), axis=2))
