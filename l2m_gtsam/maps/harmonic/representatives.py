"""Tiles that represent a whole survey: spread over it, and those where the field is roughest."""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.data import IntArray
from l2m_gtsam.maps.harmonic.tiling import Tiling
from l2m_gtsam.maps.training import TrainingSet

FEWEST = 12  # readings, three for each coefficient of a linear field


def spread_tiles(tiling: Tiling, counts: Sequence[int], number: int) -> list[int]:
    """Return tiles far from each other among those with many readings."""
    rich = np.flatnonzero(np.asarray(counts) >= np.median(counts))
    centres = tiling.grid.centres[rich]
    chosen = [int(np.argmax(np.asarray(counts)[rich]))]
    away = np.full(len(rich), np.inf)
    while len(chosen) < min(number, len(rich)):
        away = np.minimum(away, np.linalg.norm(centres - centres[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(away)))
    return [int(rich[c]) for c in chosen]


def rough_tiles(
    readings: TrainingSet, members: Sequence[IntArray], number: int, besides: Sequence[int]
) -> list[int]:
    """Return tiles where the field is roughest, besides those that are looked at already.

    Steel is not spread evenly. A patch of it that no other tile shows is what a map knows least
    and would be most wrong about.

    Parameters
    ----------
    readings
        Readings of the whole survey, map frame, metres and uT.
    members
        Rows of the readings that take part in each tile.
    number
        How many are wanted; there may be fewer.
    besides
        Indices of tiles that are chosen already.
    """
    rough = np.array([roughness(readings[rows]) for rows in members])
    rough[list(besides)] = 0.0
    roughest = np.argsort(-rough, kind="stable")[:number]
    return [int(tile) for tile in roughest if rough[tile] > 0]


def roughness(readings: TrainingSet) -> float:
    """Return what a linear field leaves of the readings, root mean square in uT; 0 for a few."""
    if len(readings) < FEWEST:
        return 0.0
    away = readings.points - readings.points.mean(axis=0)
    linear = np.column_stack([np.ones(len(away)), away])
    fitted = np.linalg.lstsq(linear, readings.field, rcond=None)[0]
    return float(np.sqrt(np.mean((readings.field - linear @ fitted) ** 2)))
