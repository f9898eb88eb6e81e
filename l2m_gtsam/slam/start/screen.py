r"""Which places and headings of a lattice can be where a pattern of fields was read.

Within half a step of the truth a reading's residual is that of the truth, e, and at most a
tolerance more: slope times displacement, what half a heading turns the field by, and what the
tangent leaves. By Cauchy and Schwarz

.. math::
    (|e| + \tau)^2 \le (\sigma^2 + \tau^2) \, (|e|^2 / \sigma^2 + 1)

so that with the tolerance as a further variance the truth's node scores no more than the truth
itself, and one for each reading. The tilt of the pattern is common to all readings and solved for
on the way, which only lowers a score. Nodes beyond what noise and outliers leave are given up as
soon as a part of the readings says so: most of them after a few.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.slam.start.field_lattice import FieldLattice
from l2m_gtsam.slam.start.options import StartSearchOptions
from l2m_gtsam.slam.start.scores import LARGEST, MEAN, Heading, Nodes, Rules, write_scores
from l2m_gtsam.slam.start.window import Pattern

MOST_KEPT = 20_000  # places that are looked at further, the best
COARSEST = np.deg2rad(10.0)  # between headings
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
    """

    p: FloatArray
    yaw: FloatArray
    score: FloatArray

    def __len__(self) -> int:
        return len(self.yaw)

    def __getitem__(self, rows: IntArray) -> "Places":
        return Places(self.p[rows], self.yaw[rows], self.score[rows])


@dataclass(frozen=True)
class Screened:
    """The places that readings do not rule out, the best first, and how many were looked at."""

    places: Places
    looked_at: int


def screen(
    pattern: Pattern, lattice: FieldLattice, nodes: IntArray, options: StartSearchOptions
) -> Screened:
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
    rules, told, at = rules_of(pattern, options), nodes_of(lattice), lattice.at[nodes]

    def look(yaw: float) -> Places:
        score = np.empty(len(nodes))
        write_scores(at, told, heading(pattern, lattice.step, yaw, turn), rules, score)
        kept = np.flatnonzero(np.isfinite(score))
        return Places(lattice.places(nodes[kept]), np.full(len(kept), yaw), score[kept])

    return Screened(best_of(in_threads(look, headings)), len(headings) * len(nodes))


def heading_step(radius: float, step: float) -> float:
    """Return the angle between headings: a whole part of the circle, rad.

    At ``radius`` metres it moves a reading by no more than a ``step``.
    """
    angle = min(COARSEST, step / max(radius, step))
    return float(2 * np.pi / np.ceil(2 * np.pi / angle))


def rules_of(pattern: Pattern, options: StartSearchOptions) -> Rules:
    """Return what noise and outliers leave at most."""
    N = len(pattern.x)
    wrong = options.outliers * N
    noise = (N - wrong) * (MEAN + 1) + SIGMAS * np.sqrt(2 * MEAN * N) + LARGEST
    return Rules(
        float(noise + wrong * (LARGEST + 1)), int((1 - options.least_inside) * N), pattern.tilt**2
    )


def in_turn(pattern: Pattern) -> Pattern:
    """Return the readings in an order in which neighbours come late: the first ones tell most."""
    return pattern[np.argsort(GOLDEN * np.arange(len(pattern.x)) % 1, kind="stable")]


def nodes_of(lattice: FieldLattice) -> Nodes:
    """Return a lattice as the kernel takes it."""
    return Nodes(*(getattr(lattice, name) for name in Nodes._fields))


def heading(pattern: Pattern, step: float, yaw: float, turn: float) -> Heading:
    """Return a pattern with a heading, among headings ``turn`` apart; both in rad."""
    Rz = about_z(yaw)
    x, field = pattern.x @ Rz.T, pattern.field @ Rz.T
    node = np.round(x / step)
    return Heading(
        node=node.astype(np.int64),
        rest=x - step * node,
        field=field,
        variance=pattern.variance,
        drift2=pattern.drift_m**2,
        moved=0.5 * (np.sqrt(3) * step + turn * np.linalg.norm(x[:, :2], axis=1)),
        swung=0.5 * turn * np.linalg.norm(field[:, :2], axis=1),
    )


def about_z(yaw: float) -> FloatArray:
    """Return the rotation about the z axis by an angle in rad, shape (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def best_of(parts: list[Places]) -> Places:
    """Return the places with the least scores, the best first."""
    p = np.concatenate([part.p for part in parts])
    yaw = np.concatenate([part.yaw for part in parts])
    score = np.concatenate([part.score for part in parts])
    return Places(p, yaw, score)[np.argsort(score, kind="stable")[:MOST_KEPT]]
