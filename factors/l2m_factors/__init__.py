"""GTSAM factors for magnetometers in a mapped field."""

from l2m_factors.block_errors import ReadingErrors
from l2m_factors.check import assert_jacobians_match
from l2m_factors.complexity import (
    ComplexityPenalty,
    effective_parameters,
    effective_parameters_factor,
)
from l2m_factors.field_map import DifferentiableMap
from l2m_factors.joint_residual import Residual, joint_residual
from l2m_factors.key_pose_readings import (
    Calibrations,
    KeyPoseReadings,
    KeyPoseResiduals,
    key_pose_residuals,
)
from l2m_factors.keys import A, B, D, F, G, K, L, M, N, P, Q, S, T, U, V, W, X
from l2m_factors.motion import PoseMotion, moved, rotation_matrices, skew
from l2m_factors.pose import MapBatch, key_pose_factor, magnetic_pose_factor
from l2m_factors.priors import distance_prior, distortion_prior, held_directions, rotation_prior
from l2m_factors.reading import BatchedReadings, block_factor, reading_factor
from l2m_factors.residual import MagneticReadings, ReadingResiduals, field_rate, reading_residuals
from l2m_factors.shared_errors import (
    SharedError,
    UncertainReadings,
    WhiteRows,
    map_weights_information,
    map_weights_prior,
    pose_errors_prior,
    shared_error,
    uncertain_block_factor,
    uncertain_reading_factor,
)
from l2m_factors.slow_error import SlowBridge, SlowError, slow_bridge, slow_error_graph
from l2m_factors.step import (
    StepError,
    drift_weights,
    drifting_fixed_axes_step,
    drifting_step,
    fixed_axes_residual,
    fixed_axes_step_factor,
    scaled_step_factor,
)
from l2m_factors.tile import (
    TileBatch,
    TileField,
    TilePlaces,
    WeightedField,
    tile_factor,
    tile_residual,
)
from l2m_factors.tile_block import TileBlocks
from l2m_factors.whitening import Whitening

__all__ = [
    "A",
    "B",
    "BatchedReadings",
    "Calibrations",
    "ComplexityPenalty",
    "D",
    "DifferentiableMap",
    "F",
    "G",
    "K",
    "KeyPoseReadings",
    "KeyPoseResiduals",
    "L",
    "M",
    "MagneticReadings",
    "MapBatch",
    "N",
    "P",
    "PoseMotion",
    "Q",
    "ReadingErrors",
    "ReadingResiduals",
    "Residual",
    "S",
    "SharedError",
    "SlowBridge",
    "SlowError",
    "StepError",
    "T",
    "TileBatch",
    "TileBlocks",
    "TileField",
    "TilePlaces",
    "U",
    "UncertainReadings",
    "V",
    "W",
    "WeightedField",
    "WhiteRows",
    "Whitening",
    "X",
    "assert_jacobians_match",
    "block_factor",
    "distance_prior",
    "distortion_prior",
    "drift_weights",
    "drifting_fixed_axes_step",
    "drifting_step",
    "effective_parameters",
    "effective_parameters_factor",
    "field_rate",
    "fixed_axes_residual",
    "fixed_axes_step_factor",
    "held_directions",
    "joint_residual",
    "key_pose_factor",
    "key_pose_residuals",
    "magnetic_pose_factor",
    "map_weights_information",
    "map_weights_prior",
    "moved",
    "pose_errors_prior",
    "reading_factor",
    "reading_residuals",
    "rotation_matrices",
    "rotation_prior",
    "scaled_step_factor",
    "shared_error",
    "skew",
    "slow_bridge",
    "slow_error_graph",
    "tile_factor",
    "tile_residual",
    "uncertain_block_factor",
    "uncertain_reading_factor",
]
