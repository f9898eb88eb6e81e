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

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from l2m_gtsam.data import FieldAndGradient, FieldSample, FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.bilinear.lattice import (
    BilinearOptions,
    Cells,
    Lattice,
    averaged,
    cells_from_state,
    lattice_over,
)
from l2m_gtsam.maps.field_map import MapSummary, masked
from l2m_gtsam.maps.trained import options_from_state, state_array
from l2m_gtsam.maps.training import (
    TrainingSet,
    additional_set,
    checked_points,
    joined,
    training_set,
)


@dataclass(frozen=True)
class BilinearMap:
    """A field map by interpolation on a grid.

    Attributes
    ----------
    readings
        Averaged over cells, map frame, metres and uT.
    options
        Options of the grid, lengths in metres.
    lattice
        Field at the nodes in uT, map frame.
    spread
        Mean square of the readings about the interpolant per axis in square microtesla.
    frame
        Name of the map frame; None where it is not known.
    """

    kind: ClassVar[str] = "bilinear"
    readings: Cells
    options: BilinearOptions
    lattice: Lattice
    spread: float
    frame: str | None = None

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
    def summary(self) -> MapSummary:
        """Figures of the map."""
        heights, points = self.readings.heights, self.readings.points
        return MapSummary(
            kind=self.kind,
            readings=int(self.readings.weight.sum()),
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
        away, _ = self.readings.tree.query(points)
        inside = np.asarray(away <= self.options.reach)
        return masked(FieldSample(field, gradient, self.variance(points), inside))

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient, outside those of the nearest data; see ``FieldMap``."""
        return self.lattice.field_and_gradient(checked_points(points))

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the one variance there is, everywhere; see ``FieldMap``."""
        return np.full(checked_points(points).shape, self.spread)

    def updated(self, points: FloatArray, field: FloatArray, /) -> "BilinearMap":
        """Return the map with more readings, averaged with the old ones; see ``FieldMap``.

        The old readings are known by the averages of their cells, so that layers are sorted anew
        by these. Their squares about the new interpolant are those about the old one, corrected
        by what the averages give: exact where the two differ by a constant over a cell.
        """
        new = additional_set(points, field)
        old = self.readings
        cells = averaged(joined(old, new), self.options)
        lattice = lattice_over(cells, self.options)
        # About its cell's mean a reading scatters as much as ever; by Steiner's theorem the squares
        # about two interpolants differ by those of the means alone.
        squares = 3 * float(old.weight.sum()) * self.spread
        squares += squares_about(lattice, old) - squares_about(self.lattice, old)
        squares = max(squares, 0.0) + squares_about(lattice, new)
        spread = squares / (3 * float(cells.weight.sum()))
        return BilinearMap(cells, self.options, lattice, spread, self.frame)

    def in_frame(self, frame: str | None, /) -> "BilinearMap":
        """Return the map with another name of its frame."""
        return replace(self, frame=frame)

    def to_state(self) -> MapState:
        """Return the map as its averages: the nodes are filled again from them."""
        own = self.readings
        arrays = {"points": own.points, "field": own.field, "count": own.weight, "layer": own.layer}
        arrays["spread"] = np.array([self.spread])
        return MapState(self.kind, arrays, self.options.model_dump(mode="json"), {})


def squares_about(lattice: Lattice, readings: TrainingSet) -> float:
    """Return the sum over readings and axes of their squared errors in square microtesla."""
    field, _ = lattice.field_and_gradient(readings.points)
    return float(readings.weight @ np.sum((readings.field - field) ** 2, axis=1))
