"""The share of a tile in a map as it is defined, one tile after another."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.tiling import Tiling


def tile_share(tiling: Tiling, points: FloatArray, tile: int) -> FloatArray:
    """Return the weight of a tile at points, (N,), before all tiles' weights are normalised."""
    away = np.abs(points[:, :2] - tiling.grid.centres[tile]) - 0.5 * tiling.grid.size
    ramp = np.clip(0.5 - 0.5 * away / tiling.blend, 0.0, 1.0)
    # Twice differentiable at both ends.
    smooth = ramp * ramp * ramp * (10 + ramp * (6 * ramp - 15))
    return np.asarray(smooth[:, 0] * smooth[:, 1])
