"""How badly a pattern of fields fits at a node of a lattice: asked millions of times, compiled."""

from typing import NamedTuple

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray

LARGEST = 16.0  # of a squared residual in sigmas: passed once in a thousand readings by noise
MEAN = 3.0  # of it, by noise


class Heading(NamedTuple):
    """A pattern of N readings with a heading, in the map's axes.

    Attributes
    ----------
    node
        The node nearest to each reading, in steps from that of the origin, shape (N, 3).
    rest
        The way from there, metres, shape (N, 3).
    field
        What was read, uT, shape (N, 3).
    variance
        Of it without the map's, uT^2, shape (N,).
    drift2
        Of its place by odometry, m^2, shape (N,).
    moved
        The largest displacement within half a cell and half a heading, metres, shape (N,).
    swung
        What half a heading turns the field by, uT, shape (N,).
    """

    node: IntArray
    rest: FloatArray
    field: FloatArray
    variance: FloatArray
    drift2: FloatArray
    moved: FloatArray
    swung: FloatArray


class Rules(NamedTuple):
    """What rules a place out: its score, or how many readings are where the map has no data.

    ``tilt2`` is the variance of the pattern's tilt about each axis, rad^2.
    """

    limit: float
    most_unknown: int
    tilt2: float


class Nodes(NamedTuple):
    """A lattice as the kernel takes it; see ``FieldLattice``."""

    rows: IntArray
    field: FloatArray
    gradient: FloatArray
    slope: FloatArray
    bend: FloatArray
    variance: FloatArray


@njit(cache=True, nogil=True)
def write_scores(
    at: IntArray, nodes: Nodes, pattern: Heading, rules: Rules, score: FloatArray
) -> None:
    """Write the score of each node, shape (M, 3), as the pattern's place."""
    for m in range(len(at)):
        score[m] = score_at(at[m], nodes, pattern, rules)


@njit(cache=True, nogil=True)
def score_at(at: IntArray, nodes: Nodes, pattern: Heading, rules: Rules) -> float:
    """Return the score of a node, shape (3,), as the pattern's place; infinite beyond the limit.

    It is the least over the tilt (u, v) about the x and y axes of the squared residuals in sigmas,
    which turn by (v fz, -u fz, u fy - v fx), and the squared tilt in its own.
    """
    total, unknown, per_tilt2 = 0.0, 0, 1 / rules.tilt2
    a, b, c, g, h = per_tilt2, 0.0, per_tilt2, 0.0, 0.0  # [[a, b], [b, c]] (u, v) = (g, h)
    r = np.empty(3)
    for n in range(len(pattern.node)):
        row = row_of(nodes.rows, at, pattern.node[n])
        if row < 0:
            unknown += 1
            total += MEAN + 1
        else:
            r2 = 0.0
            for axis in range(3):
                r[axis] = pattern.field[n, axis] - nodes.field[row, axis]
                for along in range(3):
                    r[axis] -= nodes.gradient[row, axis, along] * pattern.rest[n, along]
                r2 += r[axis] ** 2
            slope = nodes.slope[row]
            tolerance = slope * pattern.moved[n] + pattern.swung[n] + nodes.bend[row]
            s2 = pattern.variance[n] + nodes.variance[row] + slope**2 * pattern.drift2[n]
            s2 += tolerance**2
            x, y, z = pattern.field[n, 0], pattern.field[n, 1], pattern.field[n, 2]
            leaning = rules.tilt2 * (x * x + y * y + 2 * z * z)
            if r2 > (LARGEST + 1) * (s2 + leaning):
                total += LARGEST + 1
            else:
                total += r2 / s2
                a += (z * z + y * y) / s2
                b -= x * y / s2
                c += (z * z + x * x) / s2
                g += (y * r[2] - z * r[1]) / s2
                h += (z * r[0] - x * r[2]) / s2
        taken = (c * g * g - 2 * b * g * h + a * h * h) / (a * c - b * b)
        if total - taken > rules.limit or unknown > rules.most_unknown:
            return np.inf
    return total - taken


@njit(cache=True, nogil=True)
def row_of(rows: IntArray, at: IntArray, node: IntArray) -> int:
    """Return which node of the lattice is so many steps from another, shapes (3,), or -1."""
    i, j, k = at[0] + node[0], at[1] + node[1], at[2] + node[2]
    if i < 0 or j < 0 or k < 0:
        return -1
    if i >= rows.shape[0] or j >= rows.shape[1] or k >= rows.shape[2]:
        return -1
    return int(rows[i, j, k])
