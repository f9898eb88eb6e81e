"""GTSAM factors for magnetometers in a mapped field."""

from l2m_factors.check import assert_jacobians_match
from l2m_factors.field_map import FieldMap
from l2m_factors.keys import D, M, S, T
from l2m_factors.map_weights import map_weights_prior, uncertain_block_factor
from l2m_factors.motion import PoseMotion, moved
from l2m_factors.priors import distortion_prior, held_directions
from l2m_factors.reading import BatchedReadings, block_factor, reading_factor
from l2m_factors.residual import MagneticReadings, ReadingResiduals, reading_residuals

__all__ = [
    "BatchedReadings",
    "D",
    "FieldMap",
    "M",
    "MagneticReadings",
    "PoseMotion",
    "ReadingResiduals",
    "S",
    "T",
    "assert_jacobians_match",
    "block_factor",
    "distortion_prior",
    "held_directions",
    "map_weights_prior",
    "moved",
    "reading_factor",
    "reading_residuals",
    "uncertain_block_factor",
]
