"""From the lattice down: places of a pattern followed to the minima that they lead to."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.graph.slam.start_screen import Places
from l2m_gtsam.graph.slam.start_window import Pattern
from l2m_gtsam.graph.view import QueryableMap

STEPS = 15
SCALE2 = 9.0  # squared residual in sigmas from which on a reading pulls less (Cauchy)
LEAST, MORE, LESS = 1e-6, 100.0, 0.1  # damping, of the curvature's trace, and its changes
SETTLED = 1e-3  # metres
UNKNOWNS = 4  # x, y, z in metres, and heading


@dataclass(frozen=True)
class Slopes:
    """Costs of S places, and their derivatives by x, y, z (m) and heading (rad).

    Attributes
    ----------
    cost
        Shape (S,).
    gradient, curvature
        Shapes (S, 4) and (S, 4, 4).
    """

    cost: FloatArray
    gradient: FloatArray
    curvature: FloatArray

    def where(self, better: BoolArray, other: "Slopes") -> "Slopes":
        """Return those of ``other`` where it is better, shape (S,)."""
        return Slopes(
            np.where(better, other.cost, self.cost),
            np.where(better[:, None], other.gradient, self.gradient),
            np.where(better[:, None, None], other.curvature, self.curvature),
        )

    def step(self, damping: FloatArray, reach: FloatArray) -> FloatArray:
        """Return damped Gauss-Newton steps, no longer than ``reach`` each, shape (S, 4)."""
        scaled = self.curvature * reach[:, None] * reach
        trace = np.trace(scaled, axis1=1, axis2=2) + np.finfo(float).tiny
        held = scaled + (damping * trace)[:, None, None] * np.eye(UNKNOWNS)
        step = -np.linalg.solve(held, (self.gradient * reach)[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        return np.asarray(reach * step / np.maximum(length, 1.0))


def descended(places: Places, pattern: Pattern, field_map: QueryableMap, longest: float) -> Places:
    """Return where places lead to by damped Gauss-Newton steps, all of them in step.

    Parameters
    ----------
    places
        Where to begin.
    pattern
        What was read.
    field_map
        The map.
    longest
        Of a step, metres at the origin and at the pattern's outermost reading.
    """
    reach = np.append(np.full(3, longest), longest / max(pattern.radius, longest))
    seen = slopes(places, pattern, field_map)
    damping = np.full(len(places), LEAST)
    for _ in range(STEPS):
        step = seen.step(damping, reach)
        tried = replace(places, p=places.p + step[:, :3], yaw=places.yaw + step[:, 3])
        there = slopes(tried, pattern, field_map)
        better = there.cost < seen.cost
        places = replace(
            places,
            p=np.where(better[:, None], tried.p, places.p),
            yaw=np.where(better, tried.yaw, places.yaw),
        )
        seen = seen.where(better, there)
        damping = np.maximum(np.where(better, LESS, MORE) * damping, LEAST)
        if (np.abs(step) < reach * SETTLED / longest).all():
            break
    return replace(places, score=seen.cost)


def slopes(places: Places, pattern: Pattern, field_map: QueryableMap) -> Slopes:
    """Return Cauchy's cost of places: what is far off counts for little."""
    S, N = len(places), len(pattern.x)
    x, field = in_map(places, pattern.x), in_map(places, pattern.field)
    points = (x + places.p[:, None]).reshape(-1, 3)
    b, G = field_map.field_and_gradient(points)
    residual = b.reshape(S, N, 3) - field
    G = G.reshape(S, N, 3, 3)
    by_turn = np.einsum("snij,snj->sni", G, across(x)) - across(field)
    J = np.concatenate([G, by_turn[..., None]], axis=3)
    slope2 = np.einsum("snij,snij->sn", G, G) / 3
    information = 1 / (pattern.variance + slope2 * pattern.drift_m**2)
    r2 = np.einsum("sni,sni->sn", residual, residual) * information
    weight = information / (1 + r2 / SCALE2)
    JW = J * weight[..., None, None]
    return Slopes(
        SCALE2 * np.log1p(r2 / SCALE2).sum(axis=1),
        np.einsum("snij,sni->sj", JW, residual),
        np.einsum("snij,snik->sjk", JW, J),
    )


def in_map(places: Places, vectors: FloatArray) -> FloatArray:
    """Return vectors of the pattern, shape (N, 3), in the map's axes at S places, (S, N, 3)."""
    c, s = np.cos(places.yaw)[:, None], np.sin(places.yaw)[:, None]
    x, y, z = vectors.T
    return np.stack([c * x - s * y, s * x + c * y, np.broadcast_to(z, (len(c), len(z)))], axis=2)


def across(vectors: FloatArray) -> FloatArray:
    """Return the derivative of vectors, shape (..., 3), by a turn about z."""
    return np.stack([-vectors[..., 1], vectors[..., 0], np.zeros(vectors.shape[:-1])], axis=-1)
