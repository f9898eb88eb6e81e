"""Which sensors of a linear graph are connected by factors."""

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from l2m_factors import D, S, T
from l2m_gtsam.data import IntArray

SENSOR = 16  # parameters of a sensor: t, C row by row, H, time offset
PLACES = {T: slice(0, 3), D: slice(3, 15), S: slice(15, 16)}


def clusters_of(linear: gtsam.GaussianFactorGraph, sensors: list[int]) -> list[tuple[int, ...]]:
    """Return the sensors in groups that no factor connects; each by itself where none do.

    What connects sensors only by way of shared weights does not count.
    """
    owner = {key(sensor): row for row, sensor in enumerate(sensors) for key in PLACES}
    pairs = [(0, 0)]
    for index in range(linear.size()):
        rows = sorted({owner[key] for key in list(linear.at(index).keys()) if key in owner})
        pairs += [(rows[0], row) for row in rows[1:]]
    at = np.array(pairs).T
    count = len(sensors)
    edges = coo_array((np.ones(at.shape[1]), (at[0], at[1])), shape=(count, count))
    _, labels = connected_components(edges, directed=False)
    named = np.array(sensors)
    return [tuple(named[labels == label].tolist()) for label in range(labels.max() + 1)]


def sensors_in(linear: gtsam.GaussianFactorGraph) -> list[int]:
    """Return the sensors whose positions are variables of a graph."""
    keys = {key for index in range(linear.size()) for key in list(linear.at(index).keys())}
    symbols = (gtsam.Symbol(key) for key in keys)
    return sorted(int(each.index()) for each in symbols if each.key() == T(each.index()))


def columns_of(cluster: tuple[int, ...]) -> dict[int, slice]:
    """Return where each key's parameters stand among those of a cluster."""
    return {
        key(sensor): slice(SENSOR * row + at.start, SENSOR * row + at.stop)
        for row, sensor in enumerate(cluster)
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
