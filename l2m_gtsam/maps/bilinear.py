"""The paper's baseline: readings averaged on a grid, interpolated between its nodes.

The area is cut into square cells around the nodes of a grid aligned with the map frame, and the
heights of the readings into layers. The readings of a cell are averaged, position and field alike;
the nodes take their values from these averages by linear interpolation within each layer
(Delaunay triangles), so that a node is not biased to the side of its cell where the drive went.
Between the nodes the field is bilinear within a layer and linear from layer to layer; with one
layer it does not depend on the height.

Such a map has no variance of its own. It states one constant, the mean square of its readings
about the interpolant: noise of the readings and what the grid is too coarse for, but nothing of
how far the data are, and too little where a cell holds a single reading.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError, cKDTree

from l2m_gtsam.data import FieldSample, FloatArray, IntArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import MapSummary, masked
from l2m_gtsam.maps.trained import options_from_state, state_array
from l2m_gtsam.maps.training import (
    FURTHEST,
    TrainingSet,
    additional_set,
    checked_points,
    joined,
    training_set,
)
from l2m_gtsam.options import Options

KIND = "bilinear"
MOST_NODES = 5_000_000  # their values take 120 MB
LEAST_STEP = 0.4  # layers; they are made no closer than half of one, less rounding
FEWEST_IN_PLANE = 3  # averages that span a triangle


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
class Cells:
    """The averages of all cells that hold a reading.

    Attributes
    ----------
    points
        Mean positions in metres, shape (M, 3).
    field
        Mean readings in microtesla, shape (M, 3).
    count
        Readings of each, shape (M,).
    layer
        Layer of each, counted from the lowest, shape (M,).
    """

    points: FloatArray
    field: FloatArray
    count: FloatArray
    layer: IntArray

    @property
    def heights(self) -> FloatArray:
        """Mean height of the readings of each layer in metres, ascending, shape (L,)."""
        return mean_of_groups(self.layer, self.points[:, 2], self.count)


@dataclass(frozen=True)
class Knots:
    """The two nodes around each point along one axis.

    Attributes
    ----------
    node
        Their indices, shape (N, 2).
    weight
        Their shares, which add up to one, shape (N, 2).
    slope
        Derivatives of the shares in 1/m, shape (N, 2): zero where the point was clamped.
    """

    node: IntArray
    weight: FloatArray
    slope: FloatArray


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

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and its exact gradient (N, 3, 3) in uT/m.

        Points outside of the box, in metres, shape (N, 3), take the value of its nearest point.
        """
        x, y, z = (knots(axis, at) for axis, at in zip(self.axes, points.T, strict=True))
        corners = self.values[
            x.node[:, :, None, None], y.node[:, None, :, None], z.node[:, None, None, :]
        ]
        field = contracted(corners, x.weight, y.weight, z.weight)
        gradient = [
            contracted(corners, x.slope, y.weight, z.weight),
            contracted(corners, x.weight, y.slope, z.weight),
            contracted(corners, x.weight, y.weight, z.slope),
        ]
        return field, np.stack(gradient, axis=2)


@dataclass(frozen=True)
class BilinearMap:
    """A field map by interpolation on a grid.

    Attributes
    ----------
    cells
        Averages of the readings.
    options
        Effective options.
    lattice
        Values at the nodes.
    spread
        Mean square of the readings about the interpolant per axis in square microtesla.
    """

    cells: Cells
    options: BilinearOptions
    lattice: Lattice
    spread: float

    @classmethod
    def fit(
        cls, points: FloatArray, field: FloatArray, options: BilinearOptions | None = None
    ) -> "BilinearMap":
        """Return the map of readings.

        Parameters
        ----------
        points
            Positions of the readings in the map frame in metres, shape (N, 3).
        field
            Readings in the map frame in microtesla, shape (N, 3).
        options
            Defaults where absent.

        Raises
        ------
        MapError
            If no map can be made of the readings.
        """
        options = BilinearOptions() if options is None else options
        readings = training_set(points, field)
        cells = averaged(readings, options)
        lattice = lattice_over(cells, options)
        return cls(cells, options, lattice, squares_about(lattice, readings) / (3 * len(readings)))

    @classmethod
    def from_state(cls, state: MapState) -> "BilinearMap":
        """Return the map that ``to_state`` took apart.

        Raises
        ------
        MapError
            If the state is damaged.
        """
        options = options_from_state(state, BilinearOptions)
        cells = cells_from_state(state, options)
        spread = state_array(state, "spread")
        if spread.shape != (1,) or not 0 <= spread[0] < np.inf:
            raise MapError("map array spread is damaged: one number, not negative, is needed")
        return cls(cells, options, lattice_over(cells, options), float(spread[0]))

    @property
    def kind(self) -> str:
        """Name of the map kind."""
        return KIND

    @property
    def readings(self) -> TrainingSet:
        """Readings in the map frame, averaged over cells."""
        return TrainingSet(self.cells.points, self.cells.field, self.cells.count)

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""
        heights, points = self.cells.heights, self.cells.points
        return MapSummary(
            kind=KIND,
            readings=int(self.cells.count.sum()),
            rows=len(points),
            lower=points.min(axis=0),
            upper=points.max(axis=0),
            facts={
                "spacing (m)": self.options.spacing,
                "layers": len(heights),
                "heights of the layers (m)": ", ".join(f"{height:.2f}" for height in heights),
                "readings about the map (uT rms)": float(np.sqrt(self.spread)),
            },
        )

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance; see ``FieldMap``."""
        points = checked_points(points)
        field, gradient = self.field_and_gradient(points)
        away, _ = cKDTree(self.cells.points).query(points)
        inside = np.asarray(away <= self.options.reach)
        return masked(FieldSample(field, gradient, self.variance(points), inside))

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient, outside those of the nearest data; see ``FieldMap``."""
        return self.lattice.field_and_gradient(checked_points(points))

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the one variance there is, everywhere; see ``FieldMap``."""
        return np.full(checked_points(points).shape, self.spread)

    def updated(self, points: FloatArray, field: FloatArray, /) -> "BilinearMap":
        """Return the map with more readings, averaged with the old ones; see ``FieldMap``.

        The old readings are known by the averages of their cells, so that layers are sorted anew
        by these. Their squares about the new interpolant are those about the old one, corrected
        by what the averages say: exact where the two differ by a constant over a cell.
        """
        new = additional_set(points, field)
        old = TrainingSet(self.cells.points, self.cells.field, self.cells.count)
        cells = averaged(joined(old, new), self.options)
        lattice = lattice_over(cells, self.options)
        squares = 3 * float(old.weight.sum()) * self.spread
        squares += squares_about(lattice, old) - squares_about(self.lattice, old)
        squares = max(squares, 0.0) + squares_about(lattice, new)
        spread = squares / (3 * float(cells.count.sum()))
        return BilinearMap(cells, self.options, lattice, spread)

    def to_state(self) -> MapState:
        """Return the map as its averages: the nodes are filled again from them."""
        arrays = {**vars(self.cells), "spread": np.array([self.spread])}
        return MapState(KIND, arrays, self.options.model_dump(mode="json"), {})


def mean_of_groups(group: IntArray, values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted mean of the values, shape (N,), of each group."""
    return np.asarray(np.bincount(group, weight * values) / np.bincount(group, weight))


def squares_about(lattice: Lattice, readings: TrainingSet) -> float:
    """Return the sum over readings and axes of their squared errors in square microtesla."""
    field, _ = lattice.field_and_gradient(readings.points)
    return float(readings.weight @ np.sum((readings.field - field) ** 2, axis=1))


def averaged(readings: TrainingSet, options: BilinearOptions) -> Cells:
    """Return the readings averaged over the cells of each layer."""
    layer = layers_of(readings.points[:, 2], readings.weight, options.layer)
    squares = np.rint(readings.points[:, :2] / options.spacing).astype(np.int64)
    keys, owner = np.unique(np.column_stack([layer, squares]), axis=0, return_inverse=True)
    columns = np.hstack([readings.points, readings.field]).T
    means = [mean_of_groups(owner, column, readings.weight) for column in columns]
    return Cells(
        points=np.column_stack(means[:3]),
        field=np.column_stack(means[3:]),
        count=np.asarray(np.bincount(owner, readings.weight)),
        layer=keys[:, 0],
    )


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
        Averages of all layers.
    layer
        Which one.
    plane
        Nodes in x and y in metres, shape (K, 2).
    options
        How far averages reach.
    """
    own = cells.layer == layer
    centre, field = cells.points[own, :2], cells.field[own]
    _, nearest = cKDTree(cells.points).query(
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


def knots(axis: FloatArray, at: FloatArray) -> Knots:
    """Return the nodes of an axis, shape (K,), around coordinates, shape (N,), both in metres."""
    low = np.clip(np.searchsorted(axis, at, side="right") - 1, 0, len(axis) - 2)
    step = axis[low + 1] - axis[low]
    share = (np.clip(at, axis[0], axis[-1]) - axis[low]) / step
    slope = np.where((at < axis[0]) | (at > axis[-1]), 0.0, 1 / step)
    return Knots(
        np.column_stack([low, low + 1]),
        np.column_stack([1 - share, share]),
        np.column_stack([-slope, slope]),
    )


def contracted(
    corners: FloatArray, along_x: FloatArray, along_y: FloatArray, along_z: FloatArray
) -> FloatArray:
    """Return the sum over the corners, shape (N, 2, 2, 2, 3), times weights (N, 2) per axis."""
    plane = np.einsum("nabci,nc->nabi", corners, along_z)
    line = np.einsum("nabi,nb->nai", plane, along_y)
    return np.asarray(np.einsum("nai,na->ni", line, along_x))


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
            f"{layer.shape} of kind {KIND} do not belong together"
        )
    sound = np.isfinite(field).all(axis=1) & np.isfinite(count) & (count > 0)
    sound &= (np.abs(points) <= FURTHEST).all(axis=1)
    if not sound.all():
        raise MapError(f"map cell {int(sound.argmin())} of {len(points)} is damaged")
    codes, layers = np.unique(layer, return_inverse=True)
    cells = Cells(points, field, count, np.asarray(layers, dtype=np.int64))
    upward = np.diff(cells.heights) >= LEAST_STEP * options.layer
    if not np.array_equal(codes, np.arange(len(codes))) or not upward.all():
        raise MapError(f"map array layer of kind {KIND} does not count its layers upward")
    return cells
