"""A map's field at the nodes of a lattice: asked once, looked up millions of times."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.training import TrainingSet

MOST_BOX = 10_000_000  # nodes; those that the map has data for take 150 bytes each
NEAR = 1.0  # metres from a reading of the survey: further off no map is asked
AXES = 3
FURTHEST = np.sqrt(AXES) / 2  # steps from a place to its nearest node


@dataclass(frozen=True)
class FieldLattice:
    """M nodes of a cubic lattice about the places that a map has data for.

    Attributes
    ----------
    step
        Metres.
    lowest
        The first node of the box in steps, shape (3,).
    rows
        Which node of the lattice each of the box is, -1 for none, shape (nx, ny, nz).
    at
        Where each node is in the box, shape (M, 3).
    field, gradient
        Of the map, uT and uT/m, shapes (M, 3) and (M, 3, 3).
    slope
        Largest change of the field per metre, its gradient's largest singular value, shape (M,).
    bend
        How far the field may be from the tangent within a node's cell, uT, shape (M,).
    variance
        Of the map, mean of the axes, uT^2, shape (M,).
    """

    step: float
    lowest: IntArray
    rows: IntArray
    at: IntArray
    field: FloatArray
    gradient: FloatArray
    slope: FloatArray
    bend: FloatArray
    variance: FloatArray

    def __len__(self) -> int:
        return len(self.at)

    def places(self, nodes: IntArray) -> FloatArray:
        """Return where nodes are in the map, metres, shape (N, 3)."""
        return np.asarray(self.step * (self.lowest + self.at[nodes]))

    def between(self, low: float, high: float) -> IntArray:
        """Return the nodes at some heights in metres, and no further off than half a step."""
        z = self.step * (self.lowest[2] + self.at[:, 2])
        half = 0.5 * self.step
        return np.flatnonzero((z >= low - half) & (z <= high + half))

    @property
    def spread(self) -> float:
        """Standard deviation of the field over the lattice, per axis, uT."""
        return float(np.sqrt(np.mean((self.field - self.field.mean(axis=0)) ** 2)))


def lattice_over(field_map: QueryableMap, survey: TrainingSet, step: float) -> FieldLattice:
    """Ask a map at the nodes of a lattice.

    Parameters
    ----------
    field_map
        The map.
    survey
        What it was made of.
    step
        Metres.

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
    bend = FURTHEST**2 * remainder(rows, at, field, gradient, step)
    variance = sample.variance[sample.inside].mean(axis=1)
    return FieldLattice(step, lowest, rows, at, field, gradient, slope, np.asarray(bend), variance)


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
    """Return how far the field of neighbours is from a node's tangent at most, uT, shape (M,)."""
    padded = np.pad(rows, 1, constant_values=-1)
    most = np.zeros(len(at))
    for axis in range(AXES):
        for way in (-1, 1):
            beside = at + 1
            beside[:, axis] += way
            neighbour = padded[tuple(beside.T)]
            off = field[neighbour] - field - way * step * gradient[:, :, axis]
            away = np.where(neighbour >= 0, np.linalg.norm(off, axis=1), 0.0)
            most = np.maximum(most, away)
    return most
