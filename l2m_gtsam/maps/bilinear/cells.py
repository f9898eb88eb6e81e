"""The readings of a bilinear map, averaged over square cells in layers of one height."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, IntArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.trained import state_array
from l2m_gtsam.maps.training import FURTHEST, TrainingSet, checked_points
from l2m_gtsam.options import Options

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


def mean_of_groups(group: IntArray, values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted mean of the values, shape (N,), of each group."""
    return np.asarray(np.bincount(group, weight * values) / np.bincount(group, weight))


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
