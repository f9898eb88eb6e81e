"""The search for sources in residuals: the last lattices about a place."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.search import Found, SearchOptions, refined


class Hill:
    """Gains that fall off from a place."""

    def __init__(self, top: FloatArray) -> None:
        self.top = top

    def gains(self, places: FloatArray) -> FloatArray:
        return np.asarray(20.0 - np.linalg.norm(places - self.top, axis=1))


FAR = cKDTree(np.full((1, 3), 50.0))


@pytest.mark.parametrize("shift", [np.zeros(3), np.array([0.13, -0.21, 0.08])])
def test_a_source_moves_to_the_top_and_stays_there(shift: FloatArray) -> None:
    """Within half of the finest lattice's diagonal, 5 cm; one that is there does not move."""
    search: Any = Hill(shift)
    start = Found(np.zeros(3), float(search.gains(np.zeros((1, 3)))[0]))
    found = refined(search, FAR, start, SearchOptions())
    assert np.linalg.norm(found.position - shift) < 0.05
    if not shift.any():
        assert found is start


def test_no_source_is_looked_for_where_readings_are() -> None:
    """Readings all about: no lattice has a place left, and the source stays."""
    search: Any = Hill(np.array([0.2, 0.0, 0.0]))
    grid = np.stack(np.meshgrid(*(np.arange(-1, 1.01, 0.2),) * 3, indexing="ij"), axis=-1)
    start = Found(np.zeros(3), 1.0)
    assert refined(search, cKDTree(grid.reshape(-1, 3)), start, SearchOptions()) is start
