r"""Which places and headings of a lattice can be where a pattern of fields was read.

Within half a step of the truth a reading's residual is that of the truth, e, and at most a
tolerance more: slope times displacement, the field's horizontal part times half a heading, and what
the tangent leaves. By Cauchy and Schwarz

.. math::
    (|e| + \tau)^2 \le (\sigma^2 + \tau^2) \, (|e|^2 / \sigma^2 + 1)

so that with the tolerance as a further variance the truth's node scores no more than the truth
itself, and one for each reading. Nodes beyond what noise and outliers leave are given up as soon as
a part of the readings says so: most of them after a few.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.graph.slam.field_lattice import FieldLattice
from l2m_gtsam.graph.slam.start_options import StartSearchOptions
from l2m_gtsam.graph.slam.start_window import Pattern
from l2m_gtsam.threads import in_threads

MOST_KEPT = 20_000  # places that are looked at further, the best
COARSEST = np.deg2rad(10.0)  # between headings
LARGEST = 16.0  # of a squared residual in sigmas: passed once in a thousand readings by noise
MEAN = 3.0  # of it, by noise
SIGMAS = 4.0  # of their sum
GOLDEN = (np.sqrt(5) - 1) / 2


@dataclass(frozen=True)
class Places:
    """N hypotheses of where a pattern lies in a map.

    Attributes
    ----------
    p
        The pattern's origin in the map, metres, shape (N, 3).
    yaw
        Heading of its x axis, rad, shape (N,).
    score
        The lower the better, shape (N,).
    looked_at
        How many were looked at.
    """

    p: FloatArray
    yaw: FloatArray
    score: FloatArray
    looked_at: int

    def __len__(self) -> int:
        return len(self.yaw)

    def __getitem__(self, rows: IntArray) -> "Places":
        return Places(self.p[rows], self.yaw[rows], self.score[rows], self.looked_at)


def screen(
    pattern: Pattern, lattice: FieldLattice, nodes: IntArray, options: StartSearchOptions
) -> Places:
    """Return the places that readings do not rule out, at most ``MOST_KEPT``.

    Parameters
    ----------
    pattern
        What was read.
    lattice
        What the map says.
    nodes
        Where on it the pattern's origin may be, indices of shape (M,).
    options
        What rules a place out.
    """
    turn = heading_step(pattern.radius, lattice.step)
    headings = turn * np.arange(round(2 * np.pi / turn))
    pattern = in_turn(pattern)
    limit, unknown = largest_score(len(pattern.x), options)

    def look(yaw: float) -> Places:
        score = np.empty(len(nodes))
        _scores(
            *(lattice.index, lattice.at[nodes], lattice.field, lattice.gradient),
            *(lattice.slope, lattice.bend, lattice.variance),
            *turned(pattern, lattice.step, yaw, turn),
            *(limit, unknown, score),
        )
        kept = np.flatnonzero(np.isfinite(score))
        where = lattice.places(nodes[kept])
        return Places(where, np.full(len(kept), yaw), score[kept], len(nodes))

    return best_of(in_threads(look, headings))


def heading_step(radius: float, step: float) -> float:
    """Return the angle between headings: a whole part of the circle, rad.

    At ``radius`` metres it moves a reading by no more than a ``step``.
    """
    angle = min(COARSEST, step / max(radius, step))
    return float(2 * np.pi / np.ceil(2 * np.pi / angle))


def largest_score(readings: int, options: StartSearchOptions) -> tuple[float, int]:
    """Return what noise and outliers leave at most, and how many may be where no map is."""
    wrong = options.outliers * readings
    noise = (readings - wrong) * (MEAN + 1) + SIGMAS * np.sqrt(2 * MEAN * readings)
    return float(noise + wrong * (LARGEST + 1)), int(0.5 * readings)


def in_turn(pattern: Pattern) -> Pattern:
    """Return the readings in an order in which neighbours come late: the first ones tell most."""
    order = np.argsort(GOLDEN * np.arange(len(pattern.x)) % 1, kind="stable")
    parts = (pattern.x, pattern.field, pattern.variance, pattern.drift_m)
    return Pattern(*(part[order] for part in parts), pattern.origin)


def turned(
    pattern: Pattern, step: float, yaw: float, turn: float
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what does not depend on the place: per reading of a pattern with this heading.

    The nearest node in steps from the pattern's (N, 3), the way from there in metres (N, 3), the
    field (N, 3) and its variance (N,) in the map's axes, the position's variance by odometry (N,),
    the largest displacement by half a cell and half a heading (N,), metres, and what half a
    heading does to the field, uT, shape (N,).
    """
    Rz = about_z(yaw)
    x, field = pattern.x @ Rz.T, pattern.field @ Rz.T
    node = np.round(x / step)
    moved = 0.5 * (np.sqrt(3) * step + turn * np.linalg.norm(x[:, :2], axis=1))
    swung = 0.5 * turn * np.linalg.norm(field[:, :2], axis=1)
    return (
        node.astype(np.int64),
        x - step * node,
        field,
        np.column_stack([pattern.variance, pattern.drift_m**2]),
        moved,
        swung,
    )


def about_z(yaw: float) -> FloatArray:
    """Return the rotation about the z axis by an angle in rad, shape (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def best_of(parts: list[Places]) -> Places:
    """Return the places with the least scores, the best first."""
    p, yaw, score = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("p", "yaw", "score")
    )
    best = np.argsort(score, kind="stable")[:MOST_KEPT]
    return Places(p[best], yaw[best], score[best], sum(part.looked_at for part in parts))


@njit(cache=True, nogil=True)
def _scores(
    index,
    at,
    field,
    gradient,
    slope,
    bend,
    variance,
    node,
    rest,
    read,
    known,
    moved,
    swung,
    limit,
    most_unknown,
    score,
):  # type: ignore[no-untyped-def]  # numba compiles it for the arrays of `screen`
    """Write the score of each node as the pattern's place; infinite beyond the limit."""
    N = len(node)
    for m in range(len(at)):
        total, unknown = 0.0, 0
        for n in range(N):
            i, j, k = at[m, 0] + node[n, 0], at[m, 1] + node[n, 1], at[m, 2] + node[n, 2]
            row = -1
            if 0 <= i < index.shape[0] and 0 <= j < index.shape[1] and 0 <= k < index.shape[2]:
                row = index[i, j, k]
            if row < 0:
                unknown += 1
                total += MEAN + 1
            else:
                r2 = 0.0
                for axis in range(3):
                    b = field[row, axis]
                    for along in range(3):
                        b += gradient[row, axis, along] * rest[n, along]
                    r2 += (read[n, axis] - b) ** 2
                tolerance = slope[row] * moved[n] + swung[n] + bend[row]
                s2 = known[n, 0] + variance[row] + slope[row] ** 2 * known[n, 1] + tolerance**2
                total += min(r2 / s2, LARGEST + 1)
            if total > limit or unknown > most_unknown:
                total = np.inf
                break
        score[m] = total
