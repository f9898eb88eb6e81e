"""What a solution leaves open, in words, from the readings that it used."""

import numpy as np

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.solve.explain import drive_facts, explain
from l2m_gtsam.solve.rank import Determinacy, RankOptions


def undetermined(
    test: Determinacy,
    readings: Readings,
    t_lidar_mag: FloatArray,
    field_map: QueryableMap,
    options: RankOptions,
) -> tuple[str, ...]:
    """Return what the readings of one sensor leave open, a sentence for each reason.

    Parameters
    ----------
    test
        The rank test of the sensor.
    readings
        Those of it that were used.
    t_lidar_mag
        Where it sits in the lidar frame in metres, shape (3,).
    field_map
        The map.
    options
        The scales of the test.
    """
    if not test.names:
        return ()
    R, p = readings.R_map_lidar, readings.p_map_lidar
    field, gradient = field_map.field_and_gradient(np.asarray(R @ t_lidar_mag + p))
    return explain(test, drive_facts(R, p, field, gradient), options)
