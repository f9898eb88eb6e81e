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
from itertools import combinations

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FloatArray
from l2m_factors.keys import D, M, P
from l2m_factors.reading import BatchedReadings

POSE = 6  # rotation and translation
PARTS = 8  # of a triangular root: 0.4 of all its products are then formed


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


@dataclass(frozen=True)
class WhiteRows:
    """Linearised residuals of n readings, white with unit variance.

    Attributes
    ----------
    residual
        ``W e``, shape (3 n,).
    jacobians
        Derivatives by each of the keys in order, each of shape (3 n, .).
    """

    residual: FloatArray
    jacobians: tuple[FloatArray, ...]


class UncertainReadings:
    """Readings of one sensor that share errors, evaluated together.

    They depend on ``T(i)``, ``D(i)``, for readings with motion on ``S(i)``, and on the errors'
    weights.

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
        reading, shape (n, 3, 3), or a lower triangular one for all of them, shape (3 n, 3 n).
    """

    def __init__(
        self,
        batch: BatchedReadings,
        rows: npt.NDArray[np.int64],
        errors: Sequence[SharedError],
        whitening: FloatArray,
    ) -> None:
        self.sensor = batch.sensor_of(int(rows[0]))
        self.keys = [*batch.keys_of(self.sensor), *(each.key for each in errors)]
        self._batch, self._rows, self._errors, self._W = batch, rows, errors, whitening
        self._seen = b""
        self._white = np.empty(0)
        self._linearised: WhiteRows | None = None

    def __len__(self) -> int:
        return len(self._rows)

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return ``e`` in uT, shape (n, 3)."""
        C = values.atVector(D(self.sensor))[:9].reshape(3, 3)
        e = self._batch.residuals(values, self.sensor).residual[self._rows]
        return np.asarray(e + shared_error(self._errors, values) @ C.T)

    def white_residual(self, values: gtsam.Values) -> FloatArray:
        """Return ``W e``, shape (3 n,), evaluated anew only if the values changed."""
        stamp = self._stamp(values)
        if stamp != self._seen:
            self._white = whitened(self._W, self.residual(values)[:, :, None]).ravel()
            self._linearised, self._seen = None, stamp
        return self._white

    def linearised(self, values: gtsam.Values) -> WhiteRows:
        """Return residuals and derivatives, evaluated anew only if the values changed."""
        white = self.white_residual(values)
        if self._linearised is None:
            self._linearised = WhiteRows(white, self._jacobians(values))
        return self._linearised

    def _jacobians(self, values: gtsam.Values) -> tuple[FloatArray, ...]:
        residuals = self._batch.residuals(values, self.sensor)
        C = values.atVector(D(self.sensor))[:9].reshape(3, 3)
        more = shared_error(self._errors, values)
        by_T, by_D, *by_S = (each[self._rows] for each in self._batch.jacobians(residuals))
        for axis in range(3):
            by_D[:, axis, 3 * axis : 3 * axis + 3] += more
        by_weights = (C @ each.features for each in self._errors)
        return tuple(whitened(self._W, each) for each in (by_T, by_D, *by_S, *by_weights))

    def _stamp(self, values: gtsam.Values) -> bytes:
        """Return the values as bytes, which compare faster than arrays."""
        weights = (values.atVector(each.key).tobytes() for each in self._errors)
        return b"".join((self._batch.stamp(values, self.sensor), *weights))


def uncertain_block_factor(readings: UncertainReadings) -> gtsam.CustomFactor:
    """Return one factor for all of some readings: the same mathematics as one each, and faster."""

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is None:
            return readings.white_residual(values)
        found = readings.linearised(values)
        for slot, jacobian in enumerate(found.jacobians):
            jacobians[slot] = jacobian
        return found.residual

    unit = gtsam.noiseModel.Unit.Create(3 * len(readings))
    return gtsam.CustomFactor(unit, readings.keys, error)


def uncertain_reading_factor(readings: UncertainReadings, reading: int) -> gtsam.CustomFactor:
    """Return the factor of one of some readings.

    Where one matrix makes all of them white, it is triangular: the factor holds what the reading
    adds to those before it, so that the factors of all readings together say what one block does.

    Parameters
    ----------
    readings
        Those that share errors.
    reading
        Which of them, from 0.
    """
    own = slice(3 * reading, 3 * reading + 3)

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        found = readings.linearised(values)
        if jacobians is not None:
            for slot, jacobian in enumerate(found.jacobians):
                jacobians[slot] = jacobian[own]
        return found.residual[own]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), readings.keys, error)


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


def map_weights_information(
    sizes: Mapping[int, int], root_information: FloatArray
) -> gtsam.LinearContainerFactor:
    """Return the same prior as a matrix of information.

    GTSAM's Cholesky squares the rows of a factor whenever it is eliminated; those of a prior on
    thousands of weights cost as much as all else. Here they are squared once, by BLAS and part by
    part, for half of a triangular root is zero, and given to GTSAM in pairs of tiles.

    Parameters
    ----------
    sizes, root_information
        As of ``map_weights_prior``; R is lower triangular.
    """
    ends = np.cumsum([0, *sizes.values()]).tolist()
    at = {tile: slice(*ends[row : row + 2]) for row, tile in enumerate(sizes)}
    information = np.zeros_like(root_information)
    for rows in np.array_split(np.arange(len(root_information)), PARTS):
        last = int(rows.max(initial=-1)) + 1
        part = root_information[rows, :last]
        information[:last, :last] += part.T @ part
    pairs, zero = gtsam.GaussianFactorGraph(), gtsam.Values()
    nothing = {tile: (np.zeros((size, size)), np.zeros(size)) for tile, size in sizes.items()}
    for tile, (_, g) in nothing.items():
        zero.insert(M(tile), g)
        pairs.push_back(gtsam.HessianFactor(M(tile), information[at[tile], at[tile]], g, 0.0))
    for one, other in combinations(sizes, 2):
        (G, g), (other_G, other_g) = nothing[one], nothing[other]
        shared = information[at[one], at[other]]
        pairs.push_back(gtsam.HessianFactor(M(one), M(other), G, shared, g, other_G, other_g, 0.0))
    return gtsam.LinearContainerFactor(gtsam.HessianFactor(pairs), zero)


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
