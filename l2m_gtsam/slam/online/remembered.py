"""How sure a map is, remembered by place: a vehicle on line asks many times a second."""

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray

# Of cells over which the variance counts as constant: sigmas are off by a tenth, seldom a quarter.
CELL_M = 0.25


class RememberedVariance:
    """A map's variance, asked once in each cell that is come to.

    A harmonic map needs a hundred times as long for it as for the field.

    Parameters
    ----------
    field_map
        The map.
    """

    def __init__(self, field_map: QueryableMap) -> None:
        self._map = field_map
        self._known: dict[tuple[int, ...], FloatArray] = {}

    def at(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis in uT^2, shape (N, 3); infinite outside of the map.

        It is that of the middle of the cell that a point lies in.

        Parameters
        ----------
        points
            In the map in metres, shape (N, 3).
        """
        cells = [tuple(cell) for cell in np.floor(points / CELL_M).astype(np.int64).tolist()]
        new = list({cell for cell in cells if cell not in self._known})
        if new:
            told = self._map.query(CELL_M * (np.array(new) + 0.5)).variance
            self._known.update(zip(new, told, strict=True))
        return np.stack([self._known[cell] for cell in cells])
