r"""Magnetic readings whose prediction is uncertain, in ways that readings share.

.. math::
    e = C (R^T B(x) + F \gamma) + H - z, \quad
    \partial e / \partial \gamma = C F

``gamma`` are weights that many readings have in common, with a prior: of the map's error in one
tile, ``M(b)``, with ``F = R^T A``; of the lidar's pose error at a knot of the drive, ``P(k)``; of
the field that recorded numbers add at a sensor, ``Q(i)``; of any other error that has a key. F is
given per reading, at the place where the graph is linearised; it changes over decimetres.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import index, indices, of_shape
from l2m_factors.field_map import FloatArray, Jacobians
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

    def check(self, count: int) -> None:
        """Raise a ValueError if it is not one of so many readings."""
        name, size = gtsam.DefaultKeyFormatter(self.key), np.shape(self.features)[-1:]
        of_shape(f"features of {name}", self.features, (count, 3, *size))

    def checked(self, count: int) -> "SharedError":
        """Return a copy for so many readings; a ValueError if it is of another number of them."""
        self.check(count)
        return SharedError(self.key, np.array(self.features, dtype=np.float64))


@dataclass(frozen=True)
class WhiteRows:
    """Linearised residuals of n readings, white with unit variance.

    Attributes
    ----------
    residual
        ``W e``, shape (3 n,).
    jacobian
        Derivatives by all variables, those of the keys in order, shape (3 n, k).
    blocks
        Which of its columns are each key's.
    """

    residual: FloatArray
    jacobian: FloatArray
    blocks: tuple[slice, ...]


class State(NamedTuple):
    """What follows from the values that n readings were last evaluated at.

    Attributes
    ----------
    stamp
        The values as bytes.
    C
        Soft iron, shape (3, 3).
    shared
        Sum of the shared errors in the lidar frame in uT, shape (n, 3).
    residual
        ``e`` in uT, shape (n, 3).
    white
        ``W e``, shape (3 n,).
    """

    stamp: bytes
    C: FloatArray
    shared: FloatArray
    residual: FloatArray
    white: FloatArray


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
        reading, shape (n, 3, 3), or a lower triangular one for all of them, shape (3 n, 3 n). It
        may be large and is not copied.

    Raises
    ------
    ValueError
        There is no reading or no error, readings are of several sensors, distortions are held in
        the batch, or an array has another shape. The line says which.
    """

    def __init__(
        self,
        batch: BatchedReadings,
        rows: npt.NDArray[np.int64],
        errors: Sequence[SharedError],
        whitening: FloatArray,
    ) -> None:
        rows = indices("rows", rows)
        self.sensor = _only_sensor(batch, rows)
        n = len(rows)
        of_shape("whitening", whitening, (3 * n, 3 * n) if np.ndim(whitening) == 2 else (n, 3, 3))
        if not errors:
            raise ValueError("errors: none; block_factor is for readings that share none")
        for each in errors:
            each.check(n)
        self.keys = [*batch.keys_of(self.sensor), *(each.key for each in errors)]
        self._batch, self._rows, self._W = batch, rows, whitening
        self._weights = [each.key for each in errors]
        self._features = np.concatenate([each.features for each in errors], axis=2)
        widths = [each.features.shape[2] for each in errors]
        ends = np.cumsum([0, *batch.widths, *widths]).tolist()
        self._blocks = tuple(slice(*pair) for pair in pairwise(ends))
        self._state: State | None = None
        self._linearised: tuple[State, WhiteRows] | None = None

    def __len__(self) -> int:
        return len(self._rows)

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return ``e`` in uT, shape (n, 3)."""
        return self._state_at(values).residual

    def white_residual(self, values: gtsam.Values) -> FloatArray:
        """Return ``W e``, shape (3 n,), evaluated anew only if the values changed."""
        return self._state_at(values).white

    def linearised(self, values: gtsam.Values) -> WhiteRows:
        """Return residuals and derivatives, evaluated anew only if the values changed."""
        state, last = self._state_at(values), self._linearised
        if last is None or last[0] is not state:
            jacobian = whitened(self._W, self._jacobian(values, state))
            self._linearised = last = state, WhiteRows(state.white, jacobian, self._blocks)
        return last[1]

    def _state_at(self, values: gtsam.Values) -> State:
        """Return the last state, or that of changed values, kept for the next call."""
        own, state = self._batch.stamp(values, self.sensor), self._state
        weights = np.concatenate([values.atVector(key) for key in self._weights])
        stamp = own + weights.tobytes()
        if state is None or state.stamp != stamp:
            C = np.frombuffer(own)[self._blocks[1]][:9].reshape(3, 3)
            shared = self._features @ weights
            e = self._batch.residuals(values, self.sensor, own).residual[self._rows] + shared @ C.T
            state = State(stamp, C, shared, e, whitened(self._W, e[:, :, None]).ravel())
            self._state, self._linearised = state, None
        return state

    def _jacobian(self, values: gtsam.Values, state: State) -> FloatArray:
        """Return derivatives by all variables, shape (n, 3, k), where the residual was taken."""
        by_C = self._blocks[1].start
        own = self._batch.jacobian(self._batch.residuals(values, self.sensor))
        J = np.empty((len(self), 3, self._blocks[-1].stop))
        J[:, :, : own.shape[2]] = own[self._rows]
        for axis in range(3):
            first = by_C + 3 * axis
            J[:, axis, first : first + 3] += state.shared
        np.matmul(state.C, self._features, out=J[:, :, own.shape[2] :])
        return J


def uncertain_block_factor(readings: UncertainReadings) -> gtsam.CustomFactor:
    """Return one factor for all of some readings: the same mathematics as one each, and faster."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        if jacobians is None:
            return readings.white_residual(values)
        found = readings.linearised(values)
        for slot, block in enumerate(found.blocks):
            jacobians[slot] = found.jacobian[:, block]
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

    Raises
    ------
    ValueError
        There is no such reading.
    """
    index("reading", reading, len(readings))
    own = slice(3 * reading, 3 * reading + 3)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        found = readings.linearised(values)
        if jacobians is not None:
            for slot, block in enumerate(found.blocks):
                jacobians[slot] = found.jacobian[own, block]
        return found.residual[own]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), readings.keys, error)


def _only_sensor(batch: BatchedReadings, rows: npt.NDArray[np.int64]) -> int:
    """Return the sensor of all these readings, whose distortion must be a variable."""
    if not len(rows):
        raise ValueError("rows: none; at least one reading is needed")
    sensors = batch.sensors_of(rows)
    if len(sensors) > 1:
        raise ValueError(f"rows: of sensors {sensors}; make UncertainReadings of each sensor")
    if D(sensors[0]) not in batch.keys_of(sensors[0]):
        name = f"D{sensors[0]}"
        raise ValueError(f"batch: its distortions are held; leave them out, with a prior on {name}")
    return sensors[0]


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
        of ``sizes``, shape (K, K). It may be large and is not copied.

    Raises
    ------
    ValueError
        It has another shape.
    """
    whole = sum(sizes.values())
    of_shape("root_information", root_information, (whole, whole))
    ends = np.cumsum(list(sizes.values()))
    blocks = np.split(root_information, ends[:-1], axis=1)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        if jacobians is not None:
            for slot, block in enumerate(blocks):
                jacobians[slot] = block
        beta = np.concatenate([values.atVector(M(tile)) for tile in sizes])
        return np.asarray(root_information @ beta)

    unit = gtsam.noiseModel.Unit.Create(len(root_information))
    return gtsam.CustomFactor(unit, [M(tile) for tile in sizes], error)


def map_weights_information(
    sizes: Mapping[int, int], information: FloatArray
) -> gtsam.LinearContainerFactor:
    """Return the same prior as a matrix of information, which GTSAM takes in pairs of tiles.

    Its Cholesky squares the rows of a factor whenever it is eliminated; those of a prior on
    thousands of weights cost as much as all else.

    Parameters
    ----------
    sizes
        As of ``map_weights_prior``.
    information
        Inverse of the covariance; its lower triangle is enough, shape (K, K).

    Raises
    ------
    ValueError
        It has another shape.
    """
    ends = np.cumsum([0, *sizes.values()]).tolist()
    of_shape("information", information, (ends[-1], ends[-1]))
    at = {tile: slice(*pair) for tile, pair in zip(sizes, pairwise(ends), strict=True)}
    nothing = {tile: (np.zeros((size, size)), np.zeros(size)) for tile, size in sizes.items()}
    pairs, zero = gtsam.GaussianFactorGraph(), gtsam.Values()
    for tile, (_, g) in nothing.items():
        zero.insert(M(tile), g)
        own = np.tril(information[at[tile], at[tile]])
        own += np.tril(own, -1).T
        pairs.push_back(gtsam.HessianFactor(M(tile), own, g, 0.0))
    for one, other in combinations(sizes, 2):
        (G, g), (other_G, other_g) = nothing[one], nothing[other]
        shared = information[at[other], at[one]].T
        pairs.push_back(gtsam.HessianFactor(M(one), M(other), G, shared, g, other_G, other_g, 0.0))
    return gtsam.LinearContainerFactor(gtsam.HessianFactor(pairs), zero)


def pose_errors_prior(correlation: Sequence[float]) -> gtsam.NonlinearFactorGraph:
    """Return the prior of pose errors at knots: unit variance, each like the last in part.

    Parameters
    ----------
    correlation
        Between each knot and the next, 0 to 1 (excluded); there is one knot more.

    Raises
    ------
    ValueError
        A correlation is not in that range.
    """
    for knot, like in enumerate(correlation):
        if not 0 <= like < 1:
            raise ValueError(f"correlation: {like:g} of knot {knot}; needed is 0 to 1 (excluded)")
    graph = gtsam.NonlinearFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(POSE)
    graph.add(gtsam.PriorFactorVector(P(0), np.zeros(POSE), unit))
    for knot, like in enumerate(correlation):
        graph.add(_next_pose_error(knot, like))
    return graph


def _next_pose_error(knot: int, correlation: float) -> gtsam.CustomFactor:
    own = 1 / np.sqrt(1 - correlation**2)
    by_last, by_next = -correlation * own * np.eye(POSE), own * np.eye(POSE)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_last, by_next
        last, following = values.atVector(P(knot)), values.atVector(P(knot + 1))
        return np.asarray(own * (following - correlation * last))

    unit = gtsam.noiseModel.Unit.Create(POSE)
    return gtsam.CustomFactor(unit, [P(knot), P(knot + 1)], error)
