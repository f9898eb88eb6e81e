"""Where the compiled form of a tile is evaluated."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.potential_grid import Box


@dataclass(frozen=True)
class Places:
    """Where a tile is evaluated.

    Attributes
    ----------
    readings
        Positions of the readings near the square below in the map frame in metres, shape (K, 3).
    reach
        How far from them, in metres.
    centre
        Middle of the tile's core in x and y, metres, shape (2,).
    half
        Half the edge of the square around it in which the tile has a share, metres.
    """

    readings: FloatArray
    reach: float
    centre: FloatArray
    half: float

    @classmethod
    def around(cls, readings: "AlongX", reach: float, centre: FloatArray, half: float) -> "Places":
        """Return the places of a square near readings, which may lie anywhere."""
        return cls(readings.points[readings.within(centre, half + reach)], reach, centre, half)

    def box(self, frame: TileFrame) -> Box:
        """Return the box in the tile's frame that holds all places."""
        square = self.centre + self.half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        z = self.readings[:, 2]
        corners = [
            np.column_stack([square, np.full(4, height)])
            for height in (z.min() - self.reach, z.max() + self.reach)
        ]
        local = frame.localise(np.concatenate(corners))
        return Box(local.min(axis=0), local.max(axis=0))

    def random(self, count: int) -> FloatArray:
        """Return places in the map frame, shape (N, 3): about as many as asked for, or none."""
        if not len(self.readings):
            return np.empty((0, 3))
        rng = np.random.default_rng(0)
        offset = rng.uniform(-1, 1, (count, 3)) * self.reach
        places = self.readings[rng.integers(0, len(self.readings), count)] + offset
        return np.asarray(places[np.abs(places[:, :2] - self.centre).max(axis=1) <= self.half])


@dataclass(frozen=True)
class AlongX:
    """Readings in the order of x, so that a square is found without looking at all of them.

    Attributes
    ----------
    points
        Positions in the map frame in metres, shape (N, 3).
    order
        Their indices from the lowest x to the highest, shape (N,).
    """

    points: FloatArray
    order: IntArray

    @classmethod
    def of(cls, points: FloatArray) -> "AlongX":
        """Return readings at these positions."""
        return cls(points, np.argsort(points[:, 0], kind="stable"))

    def within(self, centre: FloatArray, half: float) -> IntArray:
        """Return the rows in a square about a centre in x and y, shape (2,), in order, (K,)."""
        edges = centre[0] + half * np.array([-1, 1])
        start, stop = np.searchsorted(self.points[:, 0], edges, sorter=self.order)
        rows = np.sort(self.order[start:stop])
        return np.asarray(rows[np.abs(self.points[rows, 1] - centre[1]) <= half])
