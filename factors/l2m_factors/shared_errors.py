r"""Magnetic readings whose prediction is uncertain, in ways that readings share.

.. math::
    e = C (R^T B(x) + F \gamma) + H - z, \quad
    \partial e / \partial \gamma = C F

``gamma`` are weights that many readings have in common, with a prior: of the map's error in one
tile, ``M(b)``, with ``F = R^T A``; of the lidar's pose error at a knot of the drive, ``P(k)``; of
the field that recorded numbers add at a sensor, ``Q(i)``. F is given per reading, at the place
where the graph is linearised; it changes over decimetres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FloatArray
from l2m_factors.keys import D, M, P
from l2m_factors.reading import BatchedReadings

POSE = 6  # rotation and translation


@dataclass(frozen=True)
class SharedError:
    """An error of the field that a map predicts for n readings.

    Attributes
    ----------
    key
        The variable that holds its weights: Vector r.
    features
        F in the lidar frame in uT, shape (n, 3, r).
    """

    key: int
    features: FloatArray


def uncertain_block_factor(
    batch: BatchedReadings,
    rows: npt.NDArray[np.int64],
    errors: Sequence[SharedError],
    whitening: FloatArray,
) -> gtsam.CustomFactor:
    """Return one factor for readings of one sensor that share errors.

    It is on ``T(i)``, ``D(i)``, for readings with motion on ``S(i)``, and on the errors' weights.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    rows
        Indices of the readings in the batch, all of one sensor, shape (n,).
    errors
        What they share.
    whitening
        Matrix that makes the noise of ``W e`` white with unit variance, in 1/uT: one for each
        reading, shape (n, 3, 3), or one for all of them, shape (3 n, 3 n).
    """
    sensor = batch.sensor_of(int(rows[0]))
    keys = [*batch.keys_of(sensor), *(each.key for each in errors)]

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        residuals = batch.residuals(values, sensor)
        C = values.atVector(D(sensor))[:9].reshape(3, 3)
        more = shared_error(errors, values)
        e = residuals.residual[rows] + more @ C.T
        if jacobians is not None:
            by_T, by_D, *by_S = (each[rows] for each in batch.jacobians(residuals))
            for axis in range(3):
                by_D[:, axis, 3 * axis : 3 * axis + 3] += more
            by_weights = (C @ each.features for each in errors)
            for slot, jacobian in enumerate((by_T, by_D, *by_S, *by_weights)):
                jacobians[slot] = whitened(whitening, jacobian)
        return whitened(whitening, e[:, :, None]).ravel()

    unit = gtsam.noiseModel.Unit.Create(3 * len(rows))
    return gtsam.CustomFactor(unit, keys, error)


def shared_error(errors: Sequence[SharedError], values: gtsam.Values) -> FloatArray:
    """Return the sum of errors in the lidar frame in uT, shape (n, 3)."""
    return np.asarray(sum(each.features @ values.atVector(each.key) for each in errors))


def whitened(whitening: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return ``W J`` for J of n readings, shape (n, 3, k), in rows, shape (3 n, k)."""
    rows = 3 * len(jacobian)
    if whitening.ndim == 2:
        return np.asarray(whitening @ jacobian.reshape(rows, -1))
    return (whitening @ jacobian).reshape(rows, -1)


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


def pose_errors_prior(correlation: Sequence[float]) -> gtsam.NonlinearFactorGraph:
    """Return the prior of pose errors at knots: unit variance, each like the last in part.

    Parameters
    ----------
    correlation
        Between each knot and the next, 0 to 1 (excluded); there is one knot more.
    """
    graph = gtsam.NonlinearFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(POSE)
    graph.add(gtsam.PriorFactorVector(P(0), np.zeros(POSE), unit))
    for knot, like in enumerate(correlation):
        graph.add(_next_pose_error(knot, like))
    return graph


def _next_pose_error(knot: int, correlation: float) -> gtsam.CustomFactor:
    own = 1 / np.sqrt(1 - correlation**2)
    by_last, by_next = -correlation * own * np.eye(POSE), own * np.eye(POSE)

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_last, by_next
        last, following = values.atVector(P(knot)), values.atVector(P(knot + 1))
        return np.asarray(own * (following - correlation * last))

    unit = gtsam.noiseModel.Unit.Create(POSE)
    return gtsam.CustomFactor(unit, [P(knot), P(knot + 1)], error)
