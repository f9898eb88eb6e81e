"""How much of a map a calibration takes.

Errors of a map are a few correlated numbers in each of its tiles, and all of those that a drive
crosses are variables of one graph. Memory grows with the square of their number, time with the
cube: a drive all over a hall would take hours for what a part of it tells well enough. Of such a
drive the tiles with the most readings count. What is left out is missing in the precision, not in
the sigmas.
"""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from l2m_gtsam.calibration.view import places_of
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings, Synchronised
from l2m_gtsam.parallel.threads import in_threads

MOST_WEIGHTS = 6000  # minutes, and five gigabytes
OF_A_TILE = 60  # hardly any has more
AT_ONCE = 16  # tiles that are asked for theirs


@runtime_checkable
class TiledMap(Protocol):
    """A map of tiles, each with errors of its own."""

    def tile_of(self, points: FloatArray, /) -> IntArray:
        """Return which tile answers at each place, shape (N,)."""

    def weights_in(self, tile: int, points: FloatArray, /) -> int:
        """Return of how many numbers the errors are at places in a tile."""


@dataclass(frozen=True)
class Extent:
    """What of a drive counts.

    Attributes
    ----------
    counts
        Which readings do, shape (N,).
    tiles, crossed
        How many tiles they are in, and how many the drive crosses; zero of a map without tiles.
    """

    counts: BoolArray
    tiles: int
    crossed: int

    @property
    def left_out(self) -> int:
        """How many readings do not count."""
        return int(np.sum(~self.counts))

    def accounted(self, synchronised: Synchronised, readings: Readings) -> Synchronised:
        """Return the account of a drive without those of the N readings that do not count."""
        sensor = readings.sensor[~self.counts]
        beyond = np.bincount(sensor, minlength=len(readings.sensors)).tolist()
        pairs = zip(synchronised.counts, beyond, strict=True)
        counts = (replace(each, kept=each.kept - n, elsewhere=n) for each, n in pairs)
        return replace(synchronised, counts=tuple(counts))

    @property
    def note(self) -> str:
        """What that means for a result, a sentence."""
        share = 1 - self.left_out / len(self.counts)
        return (
            f"the drive crosses {self.crossed} tiles of the map; the readings in {self.tiles} of "
            f"them count, {share:.0%} of all, and sigmas are by these: the errors of more take too "
            "long"
        )


def extent_of(readings: Readings, field_map: object, t: FloatArray, most: int) -> Extent:
    """Return what of a drive counts.

    Parameters
    ----------
    readings
        N of S sensors.
    field_map
        The map; one without tiles takes all.
    t
        Where sensors are, about, in the lidar frame in metres, shape (S, 3).
    most
        Numbers that the map's errors may be of.
    """
    every = np.ones(len(readings), dtype=np.bool_)
    if not isinstance(field_map, TiledMap) or not len(readings):
        return Extent(every, 0, 0)
    points = places_of(readings, t)
    tile = field_map.tile_of(points)
    crossed, count = np.unique(tile, return_counts=True)
    if OF_A_TILE * len(crossed) <= most:
        return Extent(every, len(crossed), len(crossed))
    taken = _most_read(field_map, points, tile, crossed[np.argsort(-count, kind="stable")], most)
    return Extent(np.isin(tile, taken), len(taken), len(crossed))


def _most_read(
    field_map: TiledMap, points: FloatArray, tile: IntArray, in_order: IntArray, most: int
) -> IntArray:
    """Return the first tiles in an order that have no more weights than that together."""

    def weights(each: int) -> int:
        return field_map.weights_in(each, points[tile == each])

    whole = 0
    for first in range(0, len(in_order), AT_ONCE):
        some = in_order[first : first + AT_ONCE]
        ends = whole + np.cumsum(in_threads(weights, some.tolist()))
        if ends[-1] > most:
            return in_order[: max(first + int(np.searchsorted(ends, most, side="right")), 1)]
        whole = int(ends[-1])
    return in_order
