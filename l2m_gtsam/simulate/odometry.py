"""Odometry that drifts as a vehicle drives, with the covariance of its drift."""

from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.sensors import NoiseOptions

# A stated error of zero would read as an unknown one: metres and radians.
LEAST_ERROR = 1e-6


class OdometryOrigin(StrEnum):
    """Origin of the odometry frame."""

    MAP = "map"
    START = "start"


class OdometryDriftOptions(Options):
    """How odometry drifts along a drive."""

    scale: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Every distance is measured too long or too short by this share of it."""
    scale_length: Annotated[float, Field(gt=0)] = 100.0
    """After this distance in metres the sign of the scale error is drawn anew."""
    yaw_walk: Annotated[float, Field(ge=0)] = 0.05
    """Random walk of the heading, degrees after a metre; it grows with the root of the distance."""
    position_walk: Annotated[float, Field(ge=0)] = 0.01
    """Random walk of the position along each axis, metres after a metre."""
    origin: OdometryOrigin = OdometryOrigin.MAP
    """`map`: the first pose is the true one up to the noise of poses. `start`: it is the origin,
    so that odometry does not know where in the map it is."""
    frame: Annotated[str, Field(min_length=1)] = "odom"
    """Name of the frame of the poses."""


def drifting(
    poses: Trajectory, options: OdometryDriftOptions, noise: NoiseOptions, rng: np.random.Generator
) -> Trajectory:
    """Return what odometry makes of a drive, with the covariance of every pose.

    Roll and pitch do not drift: gravity holds them. Covariances accumulate from step to step,
    ``P' = Ad P Ad^T + Q``, with independent steps: those of a scale are exact for straight paths of
    ``scale_length`` and its multiples, and larger than the error elsewhere.

    Parameters
    ----------
    poses
        True poses of the lidar in the map.
    noise
        Of poses: the error of the first one.
    """
    steps = np.diff(poses.p, axis=0)
    distance = np.linalg.norm(steps, axis=1)
    yaw, shift, scale = _errors(options, distance, rng)
    start, covariance = _start(noise, rng)
    # An error of the start turns and shifts everything, one of the heading all that follows.
    turn = poses.R[0] @ start.R @ poses.R[0].T @ _about_vertical(yaw)
    measured = np.einsum("nij,nj->ni", turn[:-1], (1 + scale[:, None]) * steps + shift)
    p = np.cumsum(np.vstack([poses.p[0] + poses.R[0] @ start.t, measured]), axis=0)
    R = turn @ poses.R
    if options.origin is OdometryOrigin.START:
        R, p = R[0].T @ R, (p - p[0]) @ R[0]
    stated = _accumulated(covariance, R, p, _step_covariances(options, poses.R[1:], R[1:], p))
    return Trajectory(poses.stamp_ns, R, p, options.frame, poses.child_frame, stated)


def _errors(
    options: OdometryDriftOptions, distance: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return heading error of N poses (rad), shifts (m) and scale errors of N - 1 steps."""
    root = np.sqrt(distance)
    yaw = np.cumsum(np.deg2rad(options.yaw_walk) * root * rng.standard_normal(len(distance)))
    shift = options.position_walk * root[:, None] * rng.standard_normal((len(distance), 3))
    travelled = np.cumsum(distance) - distance
    piece = (travelled / options.scale_length).astype(np.int64)
    sign = rng.choice([-1.0, 1.0], piece.max(initial=0) + 1)
    return np.append(0.0, yaw), shift, options.scale * sign[piece]


def _start(noise: NoiseOptions, rng: np.random.Generator) -> tuple[RigidTransform, FloatArray]:
    """Return the error of the first pose and its covariance, shape (6, 6)."""
    sigma = np.repeat([np.deg2rad(noise.rotation), noise.position], 3)
    sigma = np.maximum(sigma, LEAST_ERROR)
    drawn = sigma * rng.standard_normal(6)
    return RigidTransform(Rotation.from_rotvec(drawn[:3]).as_matrix(), drawn[3:]), np.diag(sigma**2)


def _about_vertical(angle: FloatArray) -> FloatArray:
    """Return rotations about the map's vertical, shape (N, 3, 3)."""
    return Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])).as_matrix()


def _step_covariances(
    options: OdometryDriftOptions, R_map_lidar: FloatArray, R: FloatArray, p: FloatArray
) -> FloatArray:
    """Return the covariance of each step's error, a right perturbation, shape (N - 1, 6, 6).

    Parameters
    ----------
    R_map_lidar
        True rotations at the ends of the steps, which determine the vertical.
    R
        Rotations of odometry there.
    p
        Positions of odometry, one more.
    """
    steps = np.einsum("nji,nj->ni", R, np.diff(p, axis=0))
    distance = np.linalg.norm(steps, axis=1)[:, None, None]
    ahead = steps / np.maximum(distance[:, 0], np.finfo(float).tiny)
    up = R_map_lidar[:, 2]
    Q = np.zeros((len(distance), 6, 6))
    # Random walks: variances grow in proportion to the distance.
    Q[:, :3, :3] = distance * np.deg2rad(options.yaw_walk) ** 2 * up[:, :, None] * up[:, None]
    Q[:, 3:, 3:] = distance * options.position_walk**2 * np.eye(3)
    # A scale error s of random sign over pieces of length L: a piece is wrong by s L along the
    # path, variance s^2 L^2, which as independent steps is s^2 L for each metre.
    along = options.scale**2 * options.scale_length * ahead[:, :, None] * ahead[:, None]
    Q[:, 3:, 3:] += distance * along
    return Q


def _accumulated(start: FloatArray, R: FloatArray, p: FloatArray, Q: FloatArray) -> FloatArray:
    """Return the covariance of every pose, shape (N, 6, 6).

    All steps' errors are moved to the first pose, where they add up, and the sums to each pose.
    """
    # A right perturbation d at pose T is Ad(T) d at the first pose: Exp(Ad d) T = T Exp(d).
    there, back = carried_back(*_inverse(R, p - p[0])), carried_back(R, p - p[0])
    fresh = np.concatenate([start[None], Q])
    summed = np.cumsum(there @ fresh @ there.swapaxes(1, 2), axis=0)
    P = back @ summed @ back.swapaxes(1, 2)
    return np.asarray((P + P.swapaxes(1, 2)) / 2)


def _inverse(R: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    back = R.swapaxes(1, 2)
    return back, -np.einsum("nij,nj->ni", back, p)
