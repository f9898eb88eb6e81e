"""The frame of a tile: along a tilted plane, level where there is none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.frame import tile_frame


@pytest.mark.parametrize("degrees", [0.0, 0.5, 3.0, 10.0])
def test_a_tile_follows_a_tilted_plane(degrees: float) -> None:
    rng = np.random.default_rng(12)
    flat = np.column_stack([rng.uniform(-2, 2, (500, 2)), rng.normal(0, 0.01, 500)])
    R = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    frame = tile_frame(flat @ R.T, np.zeros(2), 6.0)
    axes = frame.R_map_tile
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    local = frame.localise(flat @ R.T)
    assert local[:, 2].min() == pytest.approx(0, abs=1e-12)
    assert local[:, 2].max() == pytest.approx(frame.height, abs=1e-12)
    # Below LEAST_SLOPE, 1.1 degrees, it stays level; 500 heights of 1 cm tell it to 0.02.
    tilt = np.degrees(np.arccos(axes[2, 2]))
    assert tilt == pytest.approx(degrees if degrees > 1.2 else 0.0, abs=0.1)


def test_heights_that_follow_no_plane_leave_a_tile_level() -> None:
    rng = np.random.default_rng(13)
    points = np.column_stack([rng.uniform(-2, 2, (500, 2)), rng.choice([0.3, 0.6, 0.9], 500)])
    np.testing.assert_array_equal(tile_frame(points, np.zeros(2), 6.0).R_map_tile, np.eye(3))


def two_lanes() -> FloatArray:
    """Side by side at two heights."""
    x = np.linspace(-2, 2, 80)
    return np.column_stack([x, np.repeat([0.0, 0.4], 40), np.repeat([0.4, 0.7], 40)])


FEW = np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.5], [0.0, 0.1, 0.8]])


@pytest.mark.parametrize("points", [FEW, two_lanes()], ids=["few", "lanes"])
def test_a_plane_as_steep_as_no_floor_leaves_a_tile_level(points: FloatArray) -> None:
    """37 and 80 degrees; vehicles drive on ramps of up to fifteen."""
    np.testing.assert_array_equal(tile_frame(points, np.zeros(2), 4.0).R_map_tile, np.eye(3))
