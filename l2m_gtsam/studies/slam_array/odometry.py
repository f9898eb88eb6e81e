"""Odometry of a true path that slips, or walks at random as default options state it."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.options import DriftOptions

TURN_RAD = np.deg2rad(0.05)  # of a heading after a metre
SHARE = 0.01  # of the path, that the position is wrong by


def slipping(truth: Trajectory, rng: np.random.Generator, share: float = SHARE) -> Trajectory:
    """Return odometry that slips one way, a tenth of it upwards, and whose turns wander a little.

    The slip is a share of the path along one line of the map, and does not cancel when the vehicle
    comes back as a wrong scale does.
    """
    return _slipped(truth, rng, share * np.array([1.0, 1.0, 0.1]), np.ones(3))


def slipping_on_floor(truth: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return the same of wheels on an even floor: in x, y and heading alone."""
    return _slipped(truth, rng, SHARE * np.array([1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def _slipped(
    truth: Trajectory, rng: np.random.Generator, share: FloatArray, about: FloatArray
) -> Trajectory:
    turns, steps = _steps(truth)
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    heading = rng.uniform(-np.pi, np.pi)
    slip = share * length * np.array([np.cos(heading), np.sin(heading), 1.0])
    turn = Rotation.from_matrix(turns).as_rotvec()
    turn = turn + TURN_RAD * np.sqrt(length) * about * rng.normal(size=turn.shape)
    return _chained(truth, Rotation.from_rotvec(turn).as_matrix(), steps, slip)


def walked(truth: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return wheel odometry that drifts as default options say: x, y and heading, step by step."""
    level = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
    turns, steps = _steps(truth)
    # What no step is known better than is not drift: at ten poses a second it would be most of it.
    drift = DriftOptions(least_m=1e-6, least_deg=1e-5)
    root = np.linalg.cholesky(drift_covariance(turns, steps, drift))
    off = level * np.einsum("nij,nj->ni", root, rng.normal(size=(len(steps), 6)))
    steps = steps + np.einsum("nij,nj->ni", turns, off[:, 3:])
    turns = turns @ Rotation.from_rotvec(off[:, :3]).as_matrix()
    return _chained(truth, turns, steps, np.zeros_like(steps))


def _chained(
    truth: Trajectory, turns: FloatArray, steps: FloatArray, slips: FloatArray
) -> Trajectory:
    """Return poses, each a turn, a step along the axes of the one before and a slip further."""
    R, p = [truth.R[0]], [truth.p[0]]
    for turn, step, slip in zip(turns, steps, slips, strict=True):
        p.append(p[-1] + R[-1] @ step + slip)
        R.append(R[-1] @ turn)
    return replace(truth, R=np.stack(R), p=np.stack(p))


def _steps(truth: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return each pose in the frame of the one before: rotations and positions."""
    back = truth.R[:-1].transpose(0, 2, 1)
    return back @ truth.R[1:], np.einsum("nij,nj->ni", back, np.diff(truth.p, axis=0))
