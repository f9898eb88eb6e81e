r"""Magnetic readings over a map that is itself uncertain.

.. math::
    e = C R^T (B(x) + A \beta) + H - z, \quad
    \partial e / \partial \beta = C R^T A

``beta`` are weights of the map's error in one tile, shared by all readings and all sensors there:
the variable ``M(b)``. A is given per reading, at the places where the graph is linearised; it
changes over decimetres.
"""

from collections.abc import Mapping

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FloatArray
from l2m_factors.keys import D, M
from l2m_factors.reading import BatchedReadings


def uncertain_block_factor(
    batch: BatchedReadings,
    rows: npt.NDArray[np.int64],
    tile: int,
    features: FloatArray,
    whitening: FloatArray,
) -> gtsam.CustomFactor:
    """Return one factor for readings of one sensor in one tile.

    It is on ``T(i)``, ``D(i)``, for readings with motion on ``S(i)``, and on ``M(b)``.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    rows
        Indices of the readings in the batch, all of one sensor, shape (n,).
    tile
        Index b of the tile that they lie in.
    features
        A in the map frame at each of these readings in uT, shape (n, 3, r).
    whitening
        For each of them the matrix that makes the noise of ``W e`` white with unit variance, in
        1/uT, shape (n, 3, 3).
    """
    sensor = batch.sensor_of(int(rows[0]))
    A_lidar = batch.R_lidar_map(rows) @ features

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        residuals = batch.residuals(values, sensor)
        C = values.atVector(D(sensor))[:9].reshape(3, 3)
        more = A_lidar @ values.atVector(M(tile))
        e = residuals.residual[rows] + more @ C.T
        if jacobians is not None:
            by_T, by_D, *by_S = (each[rows] for each in batch.jacobians(residuals))
            for axis in range(3):
                by_D[:, axis, 3 * axis : 3 * axis + 3] += more
            for slot, jacobian in enumerate((by_T, by_D, *by_S, C @ A_lidar)):
                jacobians[slot] = (whitening @ jacobian).reshape(3 * len(rows), -1)
        return np.asarray(np.einsum("nij,nj->ni", whitening, e).ravel())

    unit = gtsam.noiseModel.Unit.Create(3 * len(rows))
    return gtsam.CustomFactor(unit, [*batch.keys_of(sensor), M(tile)], error)


def map_weights_prior(sizes: Mapping[int, int], root_information: FloatArray) -> gtsam.CustomFactor:
    """Return the prior of the weights of several tiles together.

    Parameters
    ----------
    sizes
        Number of weights of each tile, by its index.
    root_information
        Matrix R with ``R^T R`` the inverse of their covariance, columns tile by tile in the order
        of ``sizes``, shape (K, K).
    """
    ends = np.cumsum(list(sizes.values()))
    blocks = np.split(root_information, ends[:-1], axis=1)

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is not None:
            for slot, block in enumerate(blocks):
                jacobians[slot] = block
        beta = np.concatenate([values.atVector(M(tile)) for tile in sizes])
        return np.asarray(root_information @ beta)

    unit = gtsam.noiseModel.Unit.Create(len(root_information))
    return gtsam.CustomFactor(unit, [M(tile) for tile in sizes], error)
