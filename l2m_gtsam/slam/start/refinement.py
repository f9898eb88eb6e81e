"""From the lattice down: places of a pattern followed to the minima that they lead to.

No graph: thousands of places are judged side by side, six unknowns each, in arrays. Where the drive
begins at the best of them is solved by GTSAM, with all of the drive.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import skew
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.slam.start.screening import Places, about_z
from l2m_gtsam.slam.start.window import Pattern

SCALE2 = 9.0  # squared residual in sigmas from which on a reading pulls less (Cauchy)
LEAST, MORE, LESS = 1e-6, 100.0, 0.1  # damping, of the curvature's trace, and its changes
SETTLED = 0.005  # of the longest step
UNKNOWNS = 6


@dataclass(frozen=True)
class PatternPoses:
    """Poses in a map at which a pattern may lie, S of them.

    Attributes
    ----------
    R, p
        Of the pattern in the map, shapes (S, 3, 3) and (S, 3), metres.
    cost
        The lower the better, shape (S,).
    """

    R: FloatArray
    p: FloatArray
    cost: FloatArray

    def __len__(self) -> int:
        return len(self.p)

    def __getitem__(self, rows: IntArray) -> "PatternPoses":
        return PatternPoses(self.R[rows], self.p[rows], self.cost[rows])

    @classmethod
    def upright(cls, places: Places) -> "PatternPoses":
        """Return places as poses."""
        R = np.array([about_z(yaw) for yaw in places.yaw.tolist()]).reshape(-1, 3, 3)
        return cls(R, places.p, places.score)

    def moved(self, step: FloatArray) -> "PatternPoses":
        """Return them after turns about the map's axes (rad) and shifts (m), shape (S, 6)."""
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return replace(self, R=turn @ self.R, p=self.p + step[:, 3:])

    def where(self, better: BoolArray, other: "PatternPoses") -> "PatternPoses":
        """Return those of ``other`` where it is better, shape (S,)."""
        return PatternPoses(
            np.where(better[:, None, None], other.R, self.R),
            np.where(better[:, None], other.p, self.p),
            np.where(better, other.cost, self.cost),
        )


@dataclass(frozen=True)
class Slopes:
    """Derivatives of costs by turns about the map's axes (rad) and shifts (m).

    ``gradient`` has the shape (S, 6), ``curvature``, of Gauss and Newton, (S, 6, 6).
    """

    gradient: FloatArray
    curvature: FloatArray

    def where(self, better: BoolArray, other: "Slopes") -> "Slopes":
        """Return those of ``other`` where it is better, shape (S,)."""
        return Slopes(
            np.where(better[:, None], other.gradient, self.gradient),
            np.where(better[:, None, None], other.curvature, self.curvature),
        )

    def step(self, damping: FloatArray, longest: FloatArray) -> FloatArray:
        """Return damped steps, none longer than ``longest``, shape (6,); shape (S, 6)."""
        scaled = self.curvature * longest[:, None] * longest
        trace = np.trace(scaled, axis1=1, axis2=2) + np.finfo(float).tiny
        held = scaled + (damping * trace)[:, None, None] * np.eye(UNKNOWNS)
        step = -np.linalg.solve(held, (self.gradient * longest)[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        return np.asarray(longest * step / np.maximum(length, 1.0))


def descended(
    laid: PatternPoses, pattern: Pattern, field_map: QueryableMap, longest_m: float, steps: int
) -> PatternPoses:
    """Return where poses lead to by damped Gauss-Newton steps, all of them abreast, the best first.

    Parameters
    ----------
    laid
        Where to begin.
    pattern
        What was read.
    field_map
        The map.
    longest_m
        Of a step, at the origin and at the pattern's outermost reading.
    steps
        The most.
    """
    longest = np.repeat([longest_m / max(pattern.radius, longest_m), longest_m], 3)
    laid, slopes = linearised_cost(laid, pattern, field_map)
    damping = np.full(len(laid), LEAST)
    for _ in range(steps):
        step = slopes.step(damping, longest)
        tried, there = linearised_cost(laid.moved(step), pattern, field_map)
        better = tried.cost < laid.cost
        laid, slopes = laid.where(better, tried), slopes.where(better, there)
        damping = np.maximum(np.where(better, LESS, MORE) * damping, LEAST)
        if (np.abs(step) < SETTLED * longest).all():
            break
    return laid[np.argsort(laid.cost, kind="stable")]


def linearised_cost(
    laid: PatternPoses, pattern: Pattern, field_map: QueryableMap
) -> tuple[PatternPoses, Slopes]:
    """Return poses with Cauchy's cost, to which what is far off adds little, and its slopes."""
    S, N = len(laid), len(pattern.x)
    x, read = (v @ laid.R.transpose(0, 2, 1) for v in (pattern.x, pattern.field))
    b, G = field_map.field_and_gradient((x + laid.p[:, None]).reshape(-1, 3))
    residual, G = b.reshape(S, N, 3) - read, G.reshape(S, N, 3, 3)
    x_across, read_across = (skew(v.reshape(-1, 3)).reshape(S, N, 3, 3) for v in (x, read))
    J = np.concatenate([read_across - G @ x_across, G], axis=3)
    slope2 = np.einsum("snij,snij->sn", G, G) / 3
    information = 1 / (pattern.variance + slope2 * pattern.drift_m**2)
    r2 = np.einsum("sni,sni->sn", residual, residual) * information
    JW = J * (information / (1 + r2 / SCALE2))[..., None, None]
    lean, by_turn = leaning(laid, pattern.tilt)
    gradient = np.einsum("snij,sni->sj", JW, residual)
    curvature = JW.reshape(S, -1, UNKNOWNS).transpose(0, 2, 1) @ J.reshape(S, -1, UNKNOWNS)
    gradient[:, :3] += np.einsum("sij,si->sj", by_turn, lean)
    curvature[:, :3, :3] += by_turn.transpose(0, 2, 1) @ by_turn
    cost = SCALE2 * np.log1p(r2 / SCALE2).sum(axis=1) + np.einsum("si,si->s", lean, lean)
    return replace(laid, cost=cost), Slopes(gradient, curvature)


def leaning(laid: PatternPoses, tilt: float) -> tuple[FloatArray, FloatArray]:
    """Return how far poses lean, in sigmas, (S, 3), and the derivative by turns, (S, 3, 3)."""
    up = laid.R[:, :, 2]
    return (up - [0.0, 0.0, 1.0]) / tilt, -skew(up) / tilt
