"""Which block answers for a point, against the distances to all centres."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.maps.grid import Grid


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_block_of_a_point_is_the_nearest_in_x_or_y(seed: int) -> None:
    """Also in holes between blocks, far away and on borders."""
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-4, 5, (rng.integers(1, 30), 2)), axis=0)
    grid = Grid(rng.uniform(-100, 100, 2), rng.uniform(0.5, 6), cells)
    middle = grid.centres[rng.integers(0, len(grid), 100)]
    borders = middle + rng.choice([-0.5, 0.0, 0.5], (100, 2)) * grid.size
    around = grid.centres.mean(axis=0) + rng.uniform(-8, 8, (300, 2)) * grid.size
    far = rng.choice([-1.0, 1.0], (20, 2)) * 10.0 ** rng.uniform(2, 300, (20, 2))
    points = np.column_stack([np.concatenate([borders, around, far]), np.zeros(420)])

    away = np.abs(points[:, None, :2] - grid.centres).max(axis=2)
    chosen = away[np.arange(420), grid.block_of(points)]

    # Of two that are equally far either will do; differences of coordinates are rounded.
    np.testing.assert_allclose(chosen, away.min(axis=1), rtol=0, atol=1e-15 * np.abs(points).max())
    np.testing.assert_array_equal(grid.block_of(points[:0]), np.empty(0))
