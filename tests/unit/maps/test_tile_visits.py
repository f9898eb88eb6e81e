"""Which tile answers where, against the plain rule over all tiles."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.grid import Grid
from l2m_gtsam.maps.harmonic.tiling import Tiling
from tests.reference.tile_shares import tile_share


def tiling(rng: np.random.Generator) -> Tiling:
    """Return tiles with holes between them."""
    cells = np.unique(rng.integers(-3, 4, (rng.integers(1, 25), 2)), axis=0)
    size = rng.uniform(1, 6)
    grid = Grid(rng.uniform(-100, 100, 2), size, cells)
    return Tiling(grid, 0.5, 1.0, min(0.25 * size, 0.5))


def by_the_rule(of: Tiling, points: FloatArray) -> FloatArray:
    """Return the share of every tile at every point, shape (N, T)."""
    shares = np.column_stack([tile_share(of, points, tile) for tile in range(len(of))])
    lonely = shares.sum(axis=1) == 0
    shares[lonely, of.grid.block_of(points[lonely])] = 1.0
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_visits_are_those_of_the_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    of = tiling(rng)
    around = of.grid.centres.mean(axis=0)
    points = np.concatenate([rng.uniform(-30, 30, (300, 3)), 10.0 ** rng.uniform(1, 12, (20, 3))])
    points[:, :2] += around
    # Exactly on middles, borders and corners of cells.
    on = of.grid.centres[rng.integers(0, len(of), 100)]
    points[:100, :2] = on + rng.choice([-0.5, 0.0, 0.5], (100, 2)) * of.grid.size
    found = np.zeros((len(points), len(of)))
    visits = of.by_tile(points)
    for visit in visits:
        assert (visit.share > 0).all()
        found[visit.rows, visit.tile] += visit.share
    np.testing.assert_allclose(found.sum(axis=1), 1.0, rtol=1e-15)
    # Sums of the same shares in another order.
    np.testing.assert_allclose(found, by_the_rule(of, points), rtol=1e-14, atol=1e-15)
    tiles = [visit.tile for visit in visits]
    assert tiles == sorted(set(tiles))  # each once


def test_no_points_no_visits() -> None:
    assert not tiling(np.random.default_rng(0)).by_tile(np.empty((0, 3)))
