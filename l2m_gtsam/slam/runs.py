"""Runs of rows that are marked."""

import numpy as np

from l2m_gtsam.data import BoolArray


def runs(marked: BoolArray) -> list[tuple[int, int]]:
    """Return first and past-the-last row of each run of marked rows."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return [(int(first), int(last)) for first, last in ends.reshape(-1, 2)]
