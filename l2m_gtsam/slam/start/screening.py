r"""Screening by a bound: the positions and headings of a lattice that readings do not rule out.

Within half a step of the truth a reading's residual is that of the truth, e, plus at most a
tolerance: slope times displacement, the field's rotation by half a heading step, and the remainder
of the tangent. By the Cauchy-Schwarz inequality

.. math::
    (|e| + \tau)^2 \le (\sigma^2 + \tau^2) \, (|e|^2 / \sigma^2 + 1)

so that with the tolerance as a further variance the node at the truth scores no more than the truth
itself plus one per reading. The tilt of the pattern is common to all readings and eliminated in
closed form, which only lowers a score. A node is rejected as soon as its partial sum exceeds what
noise and outliers allow: most of them after a few readings.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, RowTable, joined_rows
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.slam.options import StartSearchOptions
from l2m_gtsam.slam.start.window import AXES, Pattern

MOST_BOX = 10_000_000  # nodes; those that the map has data for take 150 bytes each
NEAR = 1.0  # metres from a reading of the survey: further off no map is asked
FURTHEST = np.sqrt(AXES) / 2  # steps from a place to its nearest node
LARGEST = 16.0  # of a squared residual in sigmas: passed once in a thousand readings by noise
MEAN = 3.0  # of it, by noise
MOST_KEPT = 20_000  # limit of hypotheses that are kept, the best
COARSEST = np.deg2rad(10.0)  # between headings
SIGMAS = 4.0  # of their sum
GOLDEN = (np.sqrt(5) - 1) / 2


class Nodes(NamedTuple):
    """What a map has at the M nodes of a lattice.

    Attributes
    ----------
    rows
        Which node each of a box is, -1 for none, shape (nx, ny, nz).
    field, gradient
        Of the map, uT and uT/m, shapes (M, 3) and (M, 3, 3).
    slope
        Largest change of the field per metre, its gradient's largest singular value, shape (M,).
    curvature
        Largest deviation of the field from its tangent within a node's cell, uT, shape (M,).
    variance
        Of the map, mean of the axes, uT^2, shape (M,).
    """

    rows: IntArray
    field: FloatArray
    gradient: FloatArray
    slope: FloatArray
    curvature: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class FieldLattice:
    """M nodes of a cubic lattice about the places that a map has data for.

    Attributes
    ----------
    step
        Metres.
    lowest
        The first node of the box in steps, shape (3,).
    at
        Where each node is in the box, shape (M, 3).
    nodes
        What the map has there.
    """

    step: float
    lowest: IntArray
    at: IntArray
    nodes: Nodes

    def __len__(self) -> int:
        return len(self.at)

    def places(self, nodes: IntArray) -> FloatArray:
        """Return the positions of nodes in the map, metres, shape (N, 3)."""
        return np.asarray(self.step * (self.lowest + self.at[nodes]))

    def between(self, low: float, high: float) -> IntArray:
        """Return the nodes between two heights in metres, or within half a step of them."""
        z = self.step * (self.lowest[2] + self.at[:, 2])
        half = 0.5 * self.step
        return np.flatnonzero((z >= low - half) & (z <= high + half))

    @property
    def spread(self) -> float:
        """Standard deviation of the field over the lattice, per axis, uT."""
        field = self.nodes.field
        return float(np.sqrt(np.mean((field - field.mean(axis=0)) ** 2)))


def lattice_over(field_map: QueryableMap, survey: TrainingSet, step: float) -> FieldLattice:
    """Query a map at the nodes of a lattice.

    Parameters
    ----------
    field_map
        Map that is queried for field, gradient and variance.
    survey
        The readings that it was made of.
    step
        Distance of nodes in metres.

    Raises
    ------
    MapError
        The lattice would not fit in memory.
    """
    lowest, near = nodes_near(survey, step)
    asked = np.argwhere(near)
    sample = field_map.query(np.asarray(step * (lowest + asked)))
    at = asked[sample.inside]
    if not len(at):
        raise MapError("the map has no data at any place of the lattice; choose a smaller step_m")
    rows = np.full(near.shape, -1)
    rows[tuple(at.T)] = np.arange(len(at))
    field, gradient = sample.field[sample.inside], sample.gradient[sample.inside]
    slope = np.asarray(np.linalg.svd(gradient, compute_uv=False)[:, 0])
    curvature = FURTHEST**2 * remainder(rows, at, field, gradient, step)
    variance = sample.variance[sample.inside].mean(axis=1)
    nodes = Nodes(rows, field, gradient, slope, np.asarray(curvature), variance)
    return FieldLattice(step, lowest, at, nodes)


def nodes_near(survey: TrainingSet, step: float) -> tuple[IntArray, BoolArray]:
    """Return the first node of a box in steps, and which of its nodes are near readings."""
    low, high = survey.points.min(axis=0) - NEAR, survey.points.max(axis=0) + NEAR
    lowest = np.floor(low / step).astype(np.int64)
    shape = np.ceil(high / step).astype(np.int64) - lowest + 1
    if np.prod(shape.astype(float)) > MOST_BOX:
        raise MapError(
            f"the map spans {' x '.join(f'{extent:.0f}' for extent in high - low)} m, too much for "
            f"a lattice of {step:g} m; choose a larger slam.start.search.step_m, or give "
            "slam.start.position and slam.start.quaternion_xyzw"
        )
    empty = np.ones(shape, dtype=np.bool_)
    empty[tuple((np.round(survey.points / step).astype(np.int64) - lowest).T)] = False
    near = step * distance_transform_edt(empty) <= NEAR
    return lowest, np.asarray(near)


def remainder(
    rows: IntArray, at: IntArray, field: FloatArray, gradient: FloatArray, step: float
) -> FloatArray:
    """Return the largest deviation of neighbours' fields from a node's tangent, uT, shape (M,)."""
    padded = np.pad(rows, 1, constant_values=-1)
    most = np.zeros(len(at))
    for axis in range(AXES):
        for side in (-1, 1):
            beside = at + 1
            beside[:, axis] += side
            neighbour = padded[tuple(beside.T)]
            off = field[neighbour] - field - side * step * gradient[:, :, axis]
            away = np.where(neighbour >= 0, np.linalg.norm(off, axis=1), 0.0)
            most = np.maximum(most, away)
    return most


class Heading(NamedTuple):
    """A pattern of N readings with a heading, in the map's axes.

    Attributes
    ----------
    node
        The node nearest to each reading, in steps from that of the origin, shape (N, 3).
    rest
        The position relative to that node, metres, shape (N, 3).
    field
        Measured field, uT, shape (N, 3).
    variance
        Of the field without the map's share, uT^2, shape (N,).
    drift2
        Variance of the position by odometry, m^2, shape (N,).
    moved
        The largest displacement within half a cell and half a heading step, metres, shape (N,).
    turned
        Change of the field by half a heading step, uT, shape (N,).
    """

    node: IntArray
    rest: FloatArray
    field: FloatArray
    variance: FloatArray
    drift2: FloatArray
    moved: FloatArray
    turned: FloatArray


class Rules(NamedTuple):
    """Limits of a hypothesis: its score, and the number of readings outside of the map.

    ``tilt2`` is the variance of the pattern's tilt about each axis, rad^2.
    """

    limit: float
    most_unknown: int
    tilt2: float


@njit(cache=True, nogil=True)
def write_scores(
    at: IntArray, nodes: Nodes, pattern: Heading, rules: Rules, score: FloatArray
) -> None:
    """Write the score of each node, shape (M, 3), as the pattern's position."""
    for m in range(len(at)):
        score[m] = score_at(at[m], nodes, pattern, rules)


@njit(cache=True, nogil=True)
def score_at(at: IntArray, nodes: Nodes, pattern: Heading, rules: Rules) -> float:
    """Return the score of a node, shape (3,), as the pattern's position; infinite beyond the limit.

    The minimum over the tilt (u, v) about the x and y axes of the squared residuals in sigmas,
    which change by (v fz, -u fz, u fy - v fx), plus the squared tilt in its sigmas.
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
            tolerance = slope * pattern.moved[n] + pattern.turned[n] + nodes.curvature[row]
            # What the cell and the step of heading may hide counts as noise: no true place is
            # lost to the coarseness of the search.
            s2 = pattern.variance[n] + nodes.variance[row] + slope**2 * pattern.drift2[n]
            s2 += tolerance**2
            x, y, z = pattern.field[n, 0], pattern.field[n, 1], pattern.field[n, 2]
            tilt_variance = rules.tilt2 * (x * x + y * y + 2 * z * z)
            if r2 > (LARGEST + 1) * (s2 + tilt_variance):
                total += LARGEST + 1
            else:
                total += r2 / s2
                a += (z * z + y * y) / s2
                b -= x * y / s2
                c += (z * z + x * x) / s2
                g += (y * r[2] - z * r[1]) / s2
                h += (z * r[0] - x * r[2]) / s2
        # Both unknowns are linear: eliminated, they lower the squares by g^T A^-1 g, written out.
        # Terms still to come only add, so that a hypothesis beyond the limit can be left here.
        by_tilt = (c * g * g - 2 * b * g * h + a * h * h) / (a * c - b * b)
        if total - by_tilt > rules.limit or unknown > rules.most_unknown:
            return np.inf
    return total - by_tilt


@njit(cache=True, nogil=True)
def row_of(rows: IntArray, at: IntArray, node: IntArray) -> int:
    """Return which node of the lattice is so many steps from another, shapes (3,), or -1."""
    i, j, k = at[0] + node[0], at[1] + node[1], at[2] + node[2]
    if i < 0 or j < 0 or k < 0:
        return -1
    if i >= rows.shape[0] or j >= rows.shape[1] or k >= rows.shape[2]:
        return -1
    return int(rows[i, j, k])


@dataclass(frozen=True)
class StartHypotheses(RowTable):
    """N hypotheses of a pattern's pose in a map.

    Attributes
    ----------
    p
        The pattern's origin in the map, metres, shape (N, 3).
    yaw
        Heading of its x axis, rad, shape (N,).
    score
        Lower is better, shape (N,).
    """

    p: FloatArray
    yaw: FloatArray
    score: FloatArray

    def __len__(self) -> int:
        return len(self.yaw)


@dataclass(frozen=True)
class ScreeningResult:
    """The hypotheses that readings do not rule out, the best first, and how many were screened."""

    places: StartHypotheses
    looked_at: int


def screen(
    pattern: Pattern, lattice: FieldLattice, nodes: IntArray, options: StartSearchOptions
) -> ScreeningResult:
    """Return the hypotheses that readings do not rule out, at most ``MOST_KEPT``.

    Parameters
    ----------
    pattern
        N readings.
    lattice
        The map on nodes.
    nodes
        Nodes where the pattern's origin may be, shape (M,).
    options
        Share of outliers, and of readings outside of the map.
    """
    turn = heading_step(pattern.radius, lattice.step)
    headings = turn * np.arange(round(2 * np.pi / turn))
    # In an order that spreads the first readings: nodes are rejected early.
    pattern = pattern[np.argsort(GOLDEN * np.arange(len(pattern.x)) % 1, kind="stable")]
    rules, at = rules_of(pattern, options), lattice.at[nodes]

    def at_heading(yaw: float) -> StartHypotheses:
        score = np.empty(len(nodes))
        write_scores(at, lattice.nodes, heading(pattern, lattice.step, yaw, turn), rules, score)
        kept = np.flatnonzero(np.isfinite(score))
        return StartHypotheses(lattice.places(nodes[kept]), np.full(len(kept), yaw), score[kept])

    return ScreeningResult(best_of(in_threads(at_heading, headings)), len(headings) * len(nodes))


def heading_step(radius: float, step: float) -> float:
    """Return the angle between headings: a whole part of the circle, rad.

    At ``radius`` metres it moves a reading by no more than a ``step``.
    """
    angle = min(COARSEST, step / max(radius, step))
    return float(2 * np.pi / np.ceil(2 * np.pi / angle))


def rules_of(pattern: Pattern, options: StartSearchOptions) -> Rules:
    """Return the limits of what noise and outliers leave."""
    N = len(pattern.x)
    wrong = options.outliers * N
    noise = (N - wrong) * (MEAN + 1) + SIGMAS * np.sqrt(2 * MEAN * N) + LARGEST
    return Rules(
        float(noise + wrong * (LARGEST + 1)), int((1 - options.least_inside) * N), pattern.tilt**2
    )


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
        turned=0.5 * turn * np.linalg.norm(field[:, :2], axis=1),
    )


def about_z(yaw: float) -> FloatArray:
    """Return the rotation about the z axis by an angle in rad, shape (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def best_of(parts: list[StartHypotheses]) -> StartHypotheses:
    """Return the hypotheses with the lowest scores, the best first."""
    every = joined_rows(parts)
    return every[np.argsort(every.score, kind="stable")[:MOST_KEPT]]
