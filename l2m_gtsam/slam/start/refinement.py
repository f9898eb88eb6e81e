"""Refinement of start hypotheses to local minima, thousands of them at once.

No factor graph: each has six unknowns, and all are solved in arrays. From the best of them GTSAM
solves the whole drive.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import skew
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, RowTable, joined_rows
from l2m_gtsam.slam.start.screening import StartHypotheses, about_z
from l2m_gtsam.slam.start.window import Pattern

SCALE2 = 9.0  # squared scale of the Cauchy loss, in sigmas
# Damping as a share of the curvature's trace, and its factors after a failure and a success.
LEAST, MORE, LESS = 1e-6, 100.0, 0.1
SETTLED = 0.005  # of the longest step: shorter ones have converged
UNKNOWNS = 6


@dataclass(frozen=True)
class PatternPoses(RowTable):
    """S poses of a pattern in a map, with their costs.

    Attributes
    ----------
    R, p
        Of the pattern in the map, shapes (S, 3, 3) and (S, 3), metres.
    cost
        Twice the negative log likelihood but for a constant, shape (S,).
    """

    R: FloatArray
    p: FloatArray
    cost: FloatArray

    def __len__(self) -> int:
        return len(self.p)

    @classmethod
    def upright(cls, places: StartHypotheses) -> "PatternPoses":
        """Return hypotheses as poses."""
        R = np.array([about_z(yaw) for yaw in places.yaw.tolist()]).reshape(-1, 3, 3)
        return cls(R, places.p, places.score)

    def moved(self, step: FloatArray) -> "PatternPoses":
        """Return them after turns about the map's axes (rad) and shifts (m), shape (S, 6)."""
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return replace(self, R=turn @ self.R, p=self.p + step[:, 3:])


@dataclass(frozen=True)
class Slopes(RowTable):
    """Derivatives of costs by turns about the map's axes (rad) and shifts (m).

    ``gradient`` has the shape (S, 6), ``curvature``, of Gauss and Newton, (S, 6, 6).
    """

    gradient: FloatArray
    curvature: FloatArray

    def damped_step(self, damping: FloatArray, longest: FloatArray) -> FloatArray:
        """Return Levenberg-Marquardt steps, none longer than ``longest`` (6,), shape (S, 6)."""
        scaled = self.curvature * longest[:, None] * longest
        trace = np.trace(scaled, axis1=1, axis2=2) + np.finfo(float).tiny
        held = scaled + (damping * trace)[:, None, None] * np.eye(UNKNOWNS)
        step = -np.linalg.solve(held, (self.gradient * longest)[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        return np.asarray(longest * step / np.maximum(length, 1.0))


def refined_poses(
    poses: PatternPoses, pattern: Pattern, field_map: QueryableMap, longest_m: float, steps: int
) -> PatternPoses:
    """Return poses after Levenberg-Marquardt steps, all at once, the best first.

    Parameters
    ----------
    poses
        S poses to start from.
    pattern
        N readings.
    field_map
        Map with ``field_and_gradient``.
    longest_m
        Limit of a step in metres, at the origin and at the pattern's outermost reading.
    steps
        Limit of steps.
    """
    longest = np.repeat([longest_m / max(pattern.radius, longest_m), longest_m], 3)
    poses, slopes = linearised_cost(poses, pattern, field_map)
    damping = np.full(len(poses), LEAST)
    for _ in range(steps):
        step = slopes.damped_step(damping, longest)
        tried, there = linearised_cost(poses.moved(step), pattern, field_map)
        better = tried.cost < poses.cost
        rows = np.arange(len(poses)) + len(poses) * better  # those tried come after the others
        poses, slopes = joined_rows([poses, tried])[rows], joined_rows([slopes, there])[rows]
        damping = np.maximum(np.where(better, LESS, MORE) * damping, LEAST)
        if (np.abs(step) < SETTLED * longest).all():
            break
    return poses[np.argsort(poses.cost, kind="stable")]


def linearised_cost(
    poses: PatternPoses, pattern: Pattern, field_map: QueryableMap
) -> tuple[PatternPoses, Slopes]:
    """Return poses with their costs under a Cauchy loss, and the derivatives."""
    S, N = len(poses), len(pattern.x)
    x, read = (v @ poses.R.transpose(0, 2, 1) for v in (pattern.x, pattern.field))
    b, G = field_map.field_and_gradient((x + poses.p[:, None]).reshape(-1, 3))
    residual, G = b.reshape(S, N, 3) - read, G.reshape(S, N, 3, 3)
    x_across, read_across = (skew(v.reshape(-1, 3)).reshape(S, N, 3, 3) for v in (x, read))
    J = np.concatenate([read_across - G @ x_across, G], axis=3)
    slope2 = np.einsum("snij,snij->sn", G, G) / 3
    information = 1 / (pattern.variance + slope2 * pattern.drift_m**2)
    r2 = np.einsum("sni,sni->sn", residual, residual) * information
    JW = J * (information / (1 + r2 / SCALE2))[..., None, None]
    lean, by_turn = tilt_prior_gradient(poses, pattern.tilt)
    gradient = np.einsum("snij,sni->sj", JW, residual)
    curvature = JW.reshape(S, -1, UNKNOWNS).transpose(0, 2, 1) @ J.reshape(S, -1, UNKNOWNS)
    gradient[:, :3] += np.einsum("sij,si->sj", by_turn, lean)
    curvature[:, :3, :3] += by_turn.transpose(0, 2, 1) @ by_turn
    cost = SCALE2 * np.log1p(r2 / SCALE2).sum(axis=1) + np.einsum("si,si->s", lean, lean)
    return replace(poses, cost=cost), Slopes(gradient, curvature)


def tilt_prior_gradient(poses: PatternPoses, tilt: float) -> tuple[FloatArray, FloatArray]:
    """Return tilts in sigmas, shape (S, 3), and their derivatives by turns, (S, 3, 3)."""
    up = poses.R[:, :, 2]
    return (up - [0.0, 0.0, 1.0]) / tilt, -skew(up) / tilt
