"""Stretches of a drive over which no sensor fits the map."""

from collections.abc import Sequence

import numpy as np

from l2m_gtsam.records.localisation_file import SensorRecord

MOST = 0.5  # share of a sensor's readings in a span of the timeline


def stretches(sensors: Sequence[SensorRecord]) -> list[tuple[float, float]]:
    """Return from when to when most readings of every sensor inside the map were rejected.

    Times are in seconds since the first key pose. One sensor alone cannot tell a place that has
    changed from itself: then there are none.
    """
    told = [each for each in sensors if each.use.used]
    if len(told) < 2:
        return []
    wrong = np.array([each.timeline.rejected for each in told])
    inside = wrong + np.array([each.timeline.used for each in told])
    read = np.flatnonzero(inside.sum(axis=0))  # spans between key poses hold nothing
    # A sensor without a reading there says nothing against it.
    all_wrong = np.all(wrong[:, read] >= MOST * inside[:, read], axis=0)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], all_wrong, [False]])))
    edges = told[0].timeline.edges
    return [(edges[read[first]], edges[read[last - 1] + 1]) for first, last in ends.reshape(-1, 2)]
