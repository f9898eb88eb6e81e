"""What of a drive counts that crosses more of a map than a calibration can take."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.calibration.extent import OF_A_TILE, extent_of
from l2m_gtsam.data import FloatArray, IntArray, Readings

SENSORS = 2
AT = np.array([[0.0, 0.3, 0.0], [0.0, -0.3, 0.0]])


class Corridor:
    """A map of tiles one metre long, each of whose errors are so many numbers."""

    def __init__(self, weights: int) -> None:
        self.weights = weights
        self.asked: list[int] = []

    def tile_of(self, points: FloatArray, /) -> IntArray:
        return np.floor(points[:, 0]).astype(np.int64)

    def weights_in(self, tile: int, points: FloatArray, /) -> int:
        assert (self.tile_of(points) == tile).all()
        self.asked.append(tile)
        return self.weights


def along(counts: list[int]) -> Readings:
    """Return so many readings in each metre of a corridor, of both sensors alike."""
    x = np.repeat(np.arange(len(counts)), counts) + 0.5
    p = np.zeros((SENSORS * len(x), 3))
    p[:, 0] = np.tile(x, SENSORS)
    N = len(p)
    R, sensor = np.tile(np.eye(3), (N, 1, 1)), np.repeat(np.arange(SENSORS), len(x))
    return Readings(("a", "b"), sensor, np.tile(np.arange(len(x)), SENSORS), R, p, np.zeros((N, 3)))


@given(st.lists(st.integers(1, 9), min_size=30, max_size=60), st.integers(20, 60))
def test_tiles_with_the_most_readings_count(counts: list[int], weights: int) -> None:
    """As many as the limit allows, and none that is left out has more readings than one of them."""
    readings, most = along(counts), 25 * OF_A_TILE
    found = extent_of(readings, Corridor(weights), AT, most)
    tile = np.floor(readings.p_map_lidar[:, 0]).astype(int)
    taken, left = np.unique(tile[found.counts]), np.unique(tile[~found.counts])
    assert found.crossed == len(counts)
    assert found.tiles == len(taken) == min(most // weights, len(counts))
    assert not set(taken) & set(left)
    if len(left):
        assert min(counts[k] for k in taken) >= max(counts[k] for k in left)
        assert f"{len(counts)} tiles" in found.note
    assert found.left_out == 2 * sum(counts[k] for k in left)


def test_a_drive_of_few_tiles_asks_for_nothing() -> None:
    field_map = Corridor(1000)
    found = extent_of(along([5] * 10), field_map, AT, 10 * OF_A_TILE)
    assert found.counts.all()
    assert not field_map.asked


def test_one_tile_counts_whatever_it_has() -> None:
    found = extent_of(along([5, 9, 3]), Corridor(1000), AT, 100)
    assert found.tiles == 1
    assert found.left_out == 2 * (5 + 3)


def test_a_map_without_tiles_takes_all() -> None:
    found = extent_of(along([5, 9, 3]), object(), AT, 100)
    assert found.counts.all()
    assert found.left_out == 0
