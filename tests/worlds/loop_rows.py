"""Readings on a loop beside steel that changed, with white noise and offsets of the sensors."""

import numpy as np
from scipy.sparse import csr_array, eye_array

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.solve.linear_algebra import RowBlocks

NOISE_UT = 0.1
DIPOLE = SourceShape.dipole(np.array([1.0, 0.8, 0.5]), np.array([3.0, -2.0, 9.0]))
BAR = DIPOLE.with_half_axis(np.array([0.0, 0.0, 0.5]))


def loop_path() -> FloatArray:
    """Return a loop about 3 by 2 m, two sensors 0.2 m apart, metres, shape (240, 3)."""
    turn = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    loop = np.column_stack([1 + 1.5 * np.cos(turn), np.sin(turn), np.zeros(120)])
    return np.concatenate([loop, loop + np.array([0.0, 0.2, 0.1])])


def rows_with(field: FloatArray, seed: int) -> MarginalRows:
    """Return rows with white noise and an unknown uniform field for each sensor."""
    points = loop_path()
    noise = NOISE_UT * np.random.default_rng(seed).normal(size=points.shape)
    offset = np.kron(np.repeat(np.eye(2), 120, axis=0), np.eye(3))
    white = csr_array(eye_array(3 * len(points)) / NOISE_UT)
    return MarginalRows(
        points=points,
        residual=field + noise + np.repeat([[3.0, -1.0, 2.0], [0.0, 5.0, -4.0]], 120, axis=0),
        whitening=white,
        nuisance=RowBlocks.of(np.asarray(offset / NOISE_UT)),
        prior=1e-4 * np.eye(6),
        slot=np.tile(np.arange(120), 2),
    )
