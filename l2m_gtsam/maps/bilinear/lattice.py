"""Readings averaged over square cells in layers of one height, and the field between nodes."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import Field
from scipy.interpolate import LinearNDInterpolator, NdBSpline
from scipy.spatial import QhullError, cKDTree

from l2m_gtsam.data import FieldAndGradient, FloatArray, IntArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.trained import state_array
from l2m_gtsam.maps.training import FURTHEST, TrainingSet, checked_points, group_means
from l2m_gtsam.options import Options

MOST_NODES = 5_000_000  # their values take 120 MB
FEWEST_IN_PLANE = 3  # averages that span a triangle
LEAST_STEP = 0.4  # layers; they are made no closer than half of one, less rounding


class BilinearOptions(Options):
    """Options of the grid; lengths are in metres."""

    spacing: float = Field(default=0.25, ge=0.01)
    """Distance of the nodes along x and y."""

    layer: float = Field(default=0.25, ge=0.01)
    """Distance of the layers that readings at several heights are sorted into, about: the height
    of a layer is the mean of its readings, and layers closer than half of this are one."""

    reach: float = Field(default=0.5, gt=0)
    """A point is inside the map when the average of some cell is this near; nodes without data
    of their layer within this, and a cell's diagonal, take the nearest average of all."""


@dataclass(frozen=True)
class Cells(TrainingSet):
    """The averages of all M cells that hold a reading; each weighs as much as its readings.

    Attributes
    ----------
    layer
        Layer of each, counted from the lowest, shape (M,).
    """

    layer: IntArray

    @property
    def heights(self) -> FloatArray:
        """Mean height of the readings of each layer in metres, ascending, shape (L,)."""
        return mean_of_groups(self.layer, self.points[:, 2], self.weight)


def mean_of_groups(group: IntArray, values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted mean of the values, shape (N,), of each group."""
    return np.asarray(np.bincount(group, weight * values) / np.bincount(group, weight))


def averaged(readings: TrainingSet, options: BilinearOptions) -> Cells:
    """Return the readings averaged over the cells of each layer."""
    layer = layers_of(readings.points[:, 2], readings.weight, options.layer)
    squares = np.rint(readings.points[:, :2] / options.spacing).astype(np.int64)
    keys, owner = np.unique(np.column_stack([layer, squares]), axis=0, return_inverse=True)
    return Cells(**vars(group_means(readings, owner)), layer=keys[:, 0])


def layers_of(heights: FloatArray, weight: FloatArray, layer: float) -> IntArray:
    """Return the layer of each height in metres, shape (N,), counted from the lowest.

    The extent is cut into equal layers around its lowest and its highest point. A cut may run
    through readings of one height: layers whose means are closer than half a layer are joined,
    lest their noise become a vertical gradient.
    """
    extent = float(np.ptp(heights))
    cuts = round(extent / layer)
    if cuts == 0:
        return np.zeros(len(heights), dtype=np.int64)
    places = np.rint((heights - heights.min()) * (cuts / extent))
    _, occupied = np.unique(places, return_inverse=True)
    means = mean_of_groups(occupied, heights, weight)
    joined = np.cumsum(np.diff(means, prepend=means[0]) >= 0.5 * layer)
    return np.asarray(joined[occupied], dtype=np.int64)


def cells_from_state(state: MapState, options: BilinearOptions) -> Cells:
    """Return the averages of a state, which may come from an untrusted file.

    Raises
    ------
    MapError
        If an array is missing, of the wrong shape, or makes no sense.
    """
    points = checked_points(state_array(state, "points"))
    field, count, layer = (state_array(state, name) for name in ("field", "count", "layer"))
    rows = (len(points),)
    if not (field.shape == points.shape and count.shape == layer.shape == rows and len(points)):
        raise MapError(
            f"map arrays points {points.shape}, field {field.shape}, count {count.shape} and layer "
            f"{layer.shape} of kind {state.kind} do not belong together"
        )
    sound = np.isfinite(field).all(axis=1) & np.isfinite(count) & (count > 0)
    sound &= (np.abs(points) <= FURTHEST).all(axis=1)
    if not sound.all():
        raise MapError(f"map cell {int(sound.argmin())} of {len(points)} is damaged")
    codes, layers = np.unique(layer, return_inverse=True)
    cells = Cells(points, field, count, np.asarray(layers, dtype=np.int64))
    upward = np.diff(cells.heights) >= LEAST_STEP * options.layer
    if not np.array_equal(codes, np.arange(len(codes))) or not upward.all():
        raise MapError(f"map array layer of kind {state.kind} does not count its layers upward")
    return cells


@dataclass(frozen=True)
class Lattice:
    """Values on the nodes of a box.

    Attributes
    ----------
    axes
        Coordinates of the nodes along x, y and z in metres, ascending, two at least.
    values
        Field at the nodes in microtesla, shape (X, Y, Z, 3).
    """

    axes: tuple[FloatArray, FloatArray, FloatArray]
    values: FloatArray

    @cached_property
    def _spline(self) -> NdBSpline:
        ends = (np.concatenate([axis[:1], axis, axis[-1:]]) for axis in self.axes)
        return NdBSpline(tuple(ends), self.values, 1)

    def field_and_gradient(self, points: FloatArray) -> FieldAndGradient:
        """Return field (N, 3) in uT and its exact gradient (N, 3, 3) in uT/m.

        Points outside of the box, in metres, shape (N, 3), take the value of its nearest point.
        """
        low, high = ([axis[end] for axis in self.axes] for end in (0, -1))
        inside = np.clip(points, low, high)
        slopes = [self._spline(inside, nu=axis) for axis in np.eye(3, dtype=np.int64)]
        gradient = np.stack(slopes, axis=2) * (inside == points)[:, None]
        return self._spline(inside), gradient


def lattice_over(cells: Cells, options: BilinearOptions) -> Lattice:
    """Return values on the nodes of a box around the averages.

    Raises
    ------
    MapError
        If there would be too many nodes.
    """
    first = np.floor(cells.points[:, :2].min(axis=0) / options.spacing)
    counts = np.floor(cells.points[:, :2].max(axis=0) / options.spacing) - first + 2
    heights = cells.heights
    nodes = float(counts.prod()) * len(heights)
    if nodes > MOST_NODES:
        raise MapError(
            f"the map's grid has {nodes:.3g} nodes of {options.spacing:g} m, at most "
            f"{MOST_NODES:,} are allowed; a larger spacing is needed, or are the positions not in "
            "metres?"
        )
    x, y = (
        options.spacing * (low + np.arange(int(count)))
        for low, count in zip(first, counts, strict=True)
    )
    plane = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    layers = [layer_values(cells, layer, plane, options) for layer in range(len(heights))]
    if len(layers) == 1:  # a second one like it: the field is the same at all heights
        heights, layers = heights + np.arange(2), layers * 2
    return Lattice((x, y, heights), np.stack(layers, axis=1).reshape(len(x), len(y), -1, 3))


def layer_values(
    cells: Cells, layer: int, plane: FloatArray, options: BilinearOptions
) -> FloatArray:
    """Return the field at the nodes of one layer in microtesla, shape (K, 3).

    Parameters
    ----------
    cells
        Averages of all layers, map frame, metres and uT.
    layer
        Number of the layer, counted from the lowest.
    plane
        Nodes in x and y in metres, shape (K, 2).
    options
        Spacing and reach of averages in metres.
    """
    own = cells.layer == layer
    centre, field = cells.points[own, :2], cells.field[own]
    _, nearest = cells.tree.query(
        np.column_stack([plane, np.full(len(plane), cells.heights[layer])])
    )
    values = cells.field[nearest]
    away, _ = cKDTree(centre).query(plane)
    # A cell's diagonal more, so that every node around a point inside is among them.
    near = away <= options.reach + np.sqrt(2) * options.spacing
    linear = triangulated(centre, field, plane[near])
    values[near] = np.where(np.isnan(linear), values[near], linear)
    return values


def triangulated(at: FloatArray, field: FloatArray, plane: FloatArray) -> FloatArray:
    """Return field (M, 3) at (M, 2) interpolated at the plane's points, NaN outside, (K, 3)."""
    nothing = np.full((len(plane), 3), np.nan)
    if len(at) < FEWEST_IN_PLANE:
        return nothing
    middle = at.mean(axis=0)  # far from the origin the triangulation would lose digits
    try:
        return np.asarray(LinearNDInterpolator(at - middle, field)(plane - middle))
    except QhullError:  # all on one line
        return nothing
