"""A tile of an unknown field, and values of what readings in it depend on."""

import gtsam
import numpy as np

from l2m_factors import M, X
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, modes_up_to
from tests.support.factor_inputs import values_for

TILE = 3
EDGE = np.array([4.0, 4.0])
FRAME = TileFrame(np.eye(3), np.array([-2.0, -2.0, -0.5]), EDGE, 1.0)
BASIS = Basis(FRAME, (modes_up_to(FLOOR, EDGE, 0.0, 2.0), modes_up_to(CEILING, EDGE, 1.0, 1.5)))


def tile_values(seed: int, key_poses: int = 2) -> gtsam.Values:
    """Return poses near each other, calibrations, and weights of the tile."""
    values, rng = values_for(seed, key_poses), np.random.default_rng(seed + 2)
    first = values.atPose3(X(0))
    for k in range(1, key_poses):
        step = np.concatenate([rng.normal(0, 0.3, 3), rng.uniform(-0.5, 0.5, 3)])
        values.update(X(k), first.compose(gtsam.Pose3.Expmap(step)))
    values.insert(M(TILE), rng.normal(size=len(BASIS)))
    return values
