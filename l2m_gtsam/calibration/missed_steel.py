"""Steel that stood there when a map was surveyed, and that the map lacks: no change.

A map keeps the readings of its survey. Where it does not explain them, as where it takes a box for
floor, a drive differs from it as if steel had come. With e what the survey's readings lack of the
map, b the field of a source that a drive shows and sigma the noise of a reading,

    sum (|e|^2 - |e - b|^2) / sigma^2

is twice the logarithm of the likelihood that the source stood there already over that it did not:
neither has parameters that the other has not. Steel that came or went since leaves -sum |b|^2 /
sigma^2, and where a source is beyond reach of the survey nothing is said.
"""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.maps.sources.search import REACH_M
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.records.places import CLEAR


def missed_by_map(shapes: Sequence[SourceShape], field_map: QueryableMap) -> BoolArray:
    """Return which sources the readings of a map's survey clearly show as well, shape (K,).

    None of a map that keeps no readings.

    Parameters
    ----------
    shapes
        Sources that a drive shows beside the map, K of them.
    field_map
        As it was surveyed.
    """
    if not shapes or not isinstance(field_map, Surveyed):
        return np.zeros(len(shapes), dtype=np.bool_)
    near = field_map.readings.tree.query_ball_point([each.position for each in shapes], REACH_M)
    read = field_map.readings[np.unique(np.concatenate([np.array(rows, int) for rows in near]))]
    if not len(read):
        return np.zeros(len(shapes), dtype=np.bool_)
    field, _ = field_map.field_and_gradient(read.points)
    lacking, weight = read.field - field, read.weight[:, None]
    variance = float(np.mean(weight * lacking**2))
    gains = []
    for shape in shapes:
        b, _ = shape.field_and_gradient(read.points)
        gains.append(float(np.sum(weight * b * (2 * lacking - b))))
    return np.array(gains) > CLEAR * variance
