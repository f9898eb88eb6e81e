"""A uniform field without sources, and the prior of tiles in it."""

import numpy as np

from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.slam.options import TileOptions
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior
from tests.worlds.exact import DipoleWorld

EXACT = np.full(15, 1e-6)  # standard deviations of a calibration
UNIFORM = DipoleWorld(np.array([22.0, 3.0, -38.0]), np.zeros((1, 3)) - 9.0, np.zeros((1, 3)))
WEAK = Hyperparameters(floor_scale=1e-3, ceiling_scale=1e-3)
PRIOR = FieldPrior(WEAK, Resolution(4.0, 3.0), TileOptions(modes=100))
