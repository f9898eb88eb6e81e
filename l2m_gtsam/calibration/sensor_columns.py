"""Where the parameters of sensors stand among the columns of a linear system."""

import numpy as np

from l2m_factors import D, S, T
from l2m_gtsam.data import IntArray

SENSOR = 16  # parameters of a sensor: t, C row by row, H, time offset
PLACES = {T: slice(0, 3), D: slice(3, 15), S: slice(15, 16)}


def keys_of(sensor: int) -> tuple[int, int, int]:
    """Return the keys of a sensor in the order of its parameters: t, C row by row, H, offset."""
    return T(sensor), D(sensor), S(sensor)


def columns_of(sensors: tuple[int, ...]) -> dict[int, slice]:
    """Return where each key's parameters stand among those of some sensors."""
    return {
        key(sensor): slice(SENSOR * row + at.start, SENSOR * row + at.stop)
        for row, sensor in enumerate(sensors)
        for key, at in PLACES.items()
    }


def rows_in(cluster: tuple[int, ...], sensor: int) -> slice:
    """Return where a sensor's parameters stand among those of its cluster."""
    start = SENSOR * cluster.index(sensor)
    return slice(start, start + SENSOR)


def columns_among(cluster: tuple[int, ...], sensors: tuple[int, ...]) -> IntArray:
    """Return where the parameters of some sensors stand among those of their cluster."""
    at = [rows_in(cluster, sensor) for sensor in sensors]
    return np.concatenate([np.arange(each.start, each.stop) for each in at])
