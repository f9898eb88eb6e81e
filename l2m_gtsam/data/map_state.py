"""A map as plain arrays and facts."""

from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from l2m_gtsam.data.arrays import FloatArray


@dataclass(frozen=True)
class LidarMap:
    """What a lidar saw of a mapped place, and where it was then.

    Attributes
    ----------
    points
        In the map frame in metres, shape (N, 3).
    R, p
        Rotations (K, 3, 3) and positions (K, 3) in metres of the lidar in the map, along the
        mapping drives, the first of them first.
    """

    points: FloatArray
    R: FloatArray
    p: FloatArray


@dataclass(frozen=True)
class MapState:
    """A map as plain arrays and facts: what a map file holds.

    Attributes
    ----------
    kind
        Name of the map kind ("sliding_gp").
    arrays
        Numeric arrays only, by name.
    options
        Effective options, plain values.
    provenance
        Sources, dates, versions: plain values.
    lidar
        What a lidar saw of the place, if that was saved with it.
    """

    kind: str
    arrays: dict[str, npt.NDArray[Any]]
    options: dict[str, Any]
    provenance: dict[str, Any]
    lidar: LidarMap | None = None
