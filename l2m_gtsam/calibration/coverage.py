"""What the readings of a view share: errors of the map, of the poses, and of recorded numbers.

The map's are in each tile, the poses' at each knot. A number q_k, a motor's current, adds q_k g_k
to the field at a sensor, in the lidar frame; the sensor reads h_k = C g_k of it. That is an error
of the map which all readings of a sensor share: variables ``Q(i)`` of the sensors that it acts on.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import gtsam
import numpy as np
from scipy.linalg import cholesky
from scipy.linalg.lapack import dtrtri

from l2m_factors import M, P, Q, SharedError, U, map_weights_information, pose_errors_prior
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND, Budget
from l2m_gtsam.calibration.factor_graph import Estimate, unit_priors
from l2m_gtsam.calibration.joint_information import slices_of
from l2m_gtsam.calibration.pose_errors import PoseKnots, pose_seconds
from l2m_gtsam.calibration.view import View, places_of
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.solve.linear_algebra import inverse_of_factor

POSE = 6  # weights of a knot
# Readings of a group: what is left of their poses' error is a matrix of three times as many rows.
MOST = 100
AXES = 3


@dataclass(frozen=True)
class Correction:
    """What a solve finds of the fields of K numbers at a sensor, beyond what was taken off before.

    Attributes
    ----------
    h
        In the sensor's frame in uT per unit of each number, shape (K, 3).
    sigma
        Standard deviations, shape (K, 3).
    """

    h: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class MovingFields:
    """The sensors whose field recorded numbers change.

    Attributes
    ----------
    scales
        Of each such sensor, the field of a unit of each number that is one standard deviation of
        its prior in uT, shape (K,).
    """

    scales: Mapping[int, FloatArray] = field(default_factory=dict)

    @property
    def sizes(self) -> dict[int, int]:
        """Number of weights of each key of the graph."""
        return {Q(sensor): AXES * len(scale) for sensor, scale in self.scales.items()}

    def errors(self, sensor: int, numbers: FloatArray | None) -> tuple[SharedError, ...]:
        """Return what readings of a sensor at these numbers, shape (n, K), share."""
        if sensor not in self.scales or numbers is None:
            return ()
        scaled = numbers * self.scales[sensor]
        features = np.einsum("nk,ij->nikj", scaled, np.eye(AXES))
        return (SharedError(Q(sensor), features.reshape(len(scaled), AXES, -1)),)

    def correction(
        self, sensor: int, weights: FloatArray, covariance: FloatArray, C: FloatArray
    ) -> Correction:
        """Return what weights, shape (3 K,), of this covariance say of a sensor's readings.

        C counts as exact: the correction is small beside what it is added to.
        """
        scale = self.scales[sensor]
        J = np.kron(np.diag(scale), C)
        h = (J @ weights).reshape(-1, AXES)
        variance = np.einsum("ij,jk,ik->i", J, covariance, J)
        return Correction(h, np.sqrt(variance).reshape(-1, AXES))


def moving_fields(readings: Readings, prior_ut: float) -> MovingFields:
    """Return the sensors whose readings come with numbers that are not zero.

    Parameters
    ----------
    readings
        The readings used.
    prior_ut
        Standard deviation of the field that a number adds when it differs from its mean by one
        standard deviation of its own, uT.
    """
    if readings.regressors is None:
        return MovingFields()
    scales = {}
    for sensor in np.unique(readings.sensor).tolist():
        numbers = readings.regressors[readings.rows_of(sensor)]
        if numbers.any():
            spread = numbers.std(axis=0)
            scales[sensor] = np.where(spread > 0, prior_ut / np.where(spread > 0, spread, 1), 0.0)
    return MovingFields(scales)


class MapErrors(Protocol):
    """The error of a map over the places of a drive: ``A beta`` in each tile."""

    @property
    def covariance(self) -> FloatArray:
        """Covariance of all beta, tile by tile, shape (K, K)."""

    def sizes(self) -> dict[int, int]:
        """Return the number of beta of each tile."""

    def owner(self, points: FloatArray, /) -> IntArray:
        """Return the tile whose beta act at each point, shape (N,)."""

    def features(self, points: FloatArray, tile: int, /) -> FloatArray:
        """Return A of a tile at points in uT, shape (N, 3, r)."""

    @property
    def spread(self) -> FloatArray:
        """Standard deviations of the s errors that the whole map has in common, one at least."""

    @property
    def shift(self) -> FloatArray:
        """How far a unit of each of them moves the map as a whole, metres, shape (3, s)."""

    def common_features(self, points: FloatArray, tile: int, /) -> FloatArray:
        """Return what they do to a tile at points beside that shift, uT, shape (N, 3, s)."""


@runtime_checkable
class UncertainMap(Protocol):
    """A map that knows how its errors are correlated."""

    def errors_over(self, points: FloatArray, /) -> MapErrors:
        """Return the map's error over places, shape (N, 3), in metres."""


@runtime_checkable
class KnowsSurvey(Protocol):
    """A map that knows how well sensors and poses of its survey were known."""

    @property
    def sensors_uncertain(self) -> bool:
        """Whether errors of the sensors are stated."""

    @property
    def poses_uncertain(self) -> bool:
        """Whether errors of the poses are stated, or were found."""


@runtime_checkable
class KnowsItself(Protocol):
    """A map that was compared with readings that it had not read."""

    @property
    def errors_over_stated(self) -> float:
        """How many times what it states its errors at these were, 1 at least."""


def errors_over_stated(field_map: object) -> float:
    """Return how many times what it states a map's errors were, 1 where nothing is known of it."""
    return field_map.errors_over_stated if isinstance(field_map, KnowsItself) else 1.0


class NothingShared:
    """A map whose errors are independent: one tile with one weight that changes no reading."""

    covariance = np.eye(1)
    spread, shift = np.empty(0), np.empty((3, 0))

    def errors_over(self, points: FloatArray, /) -> "NothingShared":
        """Return the same for any places."""
        return self

    def sizes(self) -> dict[int, int]:
        """Return the weight of the tile."""
        return {0: 1}

    def owner(self, points: FloatArray, /) -> IntArray:
        """Return the tile for each point, shape (N,)."""
        return np.zeros(len(points), dtype=np.int64)

    def features(self, points: FloatArray, tile: int, /) -> FloatArray:
        """Return that it does nothing, shape (N, 3, 1)."""
        return np.zeros((len(points), 3, 1))

    def common_features(self, points: FloatArray, tile: int, /) -> FloatArray:
        """Return no errors in common, shape (N, 3, 0)."""
        return np.empty((len(points), 3, 0))


@dataclass(frozen=True)
class Group:
    """Readings of one sensor in one tile and, where poses are uncertain, between two knots.

    Attributes
    ----------
    sensor, tile, segment
        Which; the segment is the number of the knot before, and zero without knots.
    rows
        Of the view, shape (n,).
    features
        The map's error per weight of the tile, map frame, in uT, shape (n, 3, r).
    common
        The same for the errors of the survey's sensors beside a shift of the map, (n, 3, s).
    """

    sensor: int
    tile: int
    segment: int
    rows: IntArray
    features: FloatArray
    common: FloatArray


@dataclass(frozen=True)
class Coverage:
    """The errors that readings of a view share.

    Attributes
    ----------
    groups
        All readings.
    rest
        Variance of each reading that stays independent, per axis of the map in uT^2, (N, 3).
    tiles
        Number of weights of each tile.
    lower
        Cholesky root of the covariance of all tiles' weights, shape (K, K).
    knots
        Where pose errors are variables; absent where poses are taken as exact.
    seconds
        When each pose was taken, as the knots count, shape (N,).
    moving
        The sensors whose field recorded numbers change.
    budget
        Processes that were found in the readings.
    spread
        Standard deviations of the errors that the whole map has from the sensors that surveyed,
        shape (s,). As variables of the graph they have unit variance; see ``JointInformation``.
    shift
        How far a unit of each moves the map as a whole, metres in the map frame, shape (3, s).
    """

    groups: tuple[Group, ...]
    rest: FloatArray
    tiles: dict[int, int]
    lower: FloatArray
    knots: PoseKnots | None
    seconds: FloatArray
    moving: MovingFields = field(default_factory=MovingFields)
    budget: Budget = NOTHING_FOUND
    spread: FloatArray = field(default_factory=lambda: np.empty(0))
    shift: FloatArray = field(default_factory=lambda: np.empty((3, 0)))

    def with_larger_errors(self, times: float) -> "Coverage":
        """Return the same of a map whose errors are so many times as large as it states."""
        return replace(self, rest=times**2 * self.rest, lower=times * self.lower)

    @cached_property
    def root_information(self) -> FloatArray:
        """Square root of the information of all tiles' weights, lower triangular, (K, K)."""
        root, _ = dtrtri(self.lower, lower=1)
        return np.asarray(root)

    @cached_property
    def tile_information(self) -> FloatArray:
        """Information of all tiles' weights, shape (K, K)."""
        return inverse_of_factor(self.lower.copy())  # the root itself is needed again

    @property
    def sizes(self) -> dict[int, int]:
        """Number of weights of each key of the graph."""
        knots = 0 if self.knots is None else len(self.knots.seconds)
        tiles = {M(tile): size for tile, size in self.tiles.items()}
        return tiles | {P(knot): POSE for knot in range(knots)} | self._unit_sizes

    @property
    def _unit_sizes(self) -> dict[int, int]:
        """The same of those with unit variance beforehand, each alone."""
        suite = {U(): len(self.spread)} if len(self.spread) else {}
        return suite | self.moving.sizes | self.budget.sizes

    @property
    def columns(self) -> dict[int, slice]:
        """Where the weights of each key stand among all of them."""
        return slices_of(self.sizes)

    @cached_property
    def prior(self) -> gtsam.NonlinearFactorGraph:
        """The prior of all weights, which is linear in them and the same in all rounds."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(map_weights_information(self.tiles, self.tile_information))
        graph.push_back(self._prior_beside_tiles())
        return graph

    @cached_property
    def information(self) -> FloatArray:
        """The same as a matrix, shape (K, K)."""
        tiles = self.tile_information
        information = np.zeros((sum(self.sizes.values()),) * 2)
        information[: len(tiles), : len(tiles)] = tiles
        if beside := list(self.sizes.items())[len(self.tiles) :]:
            zero, ordering = gtsam.Values(), gtsam.Ordering()
            for key, size in beside:
                zero.insert(key, np.zeros(size))
                ordering.push_back(key)
            linear = self._prior_beside_tiles().linearize(zero)
            information[len(tiles) :, len(tiles) :], _ = linear.hessian(ordering)
        return information

    def _prior_beside_tiles(self) -> gtsam.NonlinearFactorGraph:
        """Return the prior of all weights but those of tiles."""
        graph = gtsam.NonlinearFactorGraph()
        if self.knots is not None:
            graph.push_back(pose_errors_prior(self.knots.correlation.tolist()))
        graph.push_back(unit_priors(self._unit_sizes))
        return graph


def cover(view: View, errors: UncertainMap, estimate: Estimate, correlation_s: float) -> Coverage:
    """Ask the map for its errors at the readings, where the estimate puts them.

    Parameters
    ----------
    view
        The readings used.
    errors
        What the map knows of its errors.
    estimate
        Of their sensors.
    correlation_s
        How long an error of a pose lasts, seconds.
    """
    readings = view.readings
    x = places_of(readings, estimate.t)
    seconds, knots = pose_seconds(readings), None
    if readings.pose_root is not None:
        knots = PoseKnots.over(seconds, correlation_s, readings.drive)
    segment = np.zeros(len(x), dtype=np.int64) if knots is None else knots.segment(seconds)
    map_errors = errors.errors_over(x)
    owner, rest, groups = map_errors.owner(x), np.empty_like(x), []

    def asked(tile: int) -> tuple[IntArray, FloatArray, FloatArray]:
        rows = np.flatnonzero(owner == tile)
        at = x[rows]
        return rows, map_errors.features(at, tile), map_errors.common_features(at, tile)

    tiles = list(map_errors.sizes())
    for tile, (rows, features, common) in zip(tiles, in_threads(asked, tiles), strict=True):
        shared = np.einsum("nir,nir->ni", features, features)
        # beta has unit variance in each tile: A A^T is what it explains, the rest is noise.
        rest[rows] = np.maximum(view.map_variance[rows] - shared, 0.0)
        for own in together(readings, segment, rows, whole=knots is None):
            first = rows[own[0]]
            where = int(readings.sensor[first]), tile, int(segment[first])
            groups.append(Group(*where, rows[own], features[own], common[own]))
    lower = cholesky(map_errors.covariance, lower=True, check_finite=False)
    return Coverage(
        groups=tuple(groups),
        rest=rest,
        tiles=map_errors.sizes(),
        lower=lower,
        knots=knots,
        seconds=seconds,
        spread=map_errors.spread,
        shift=map_errors.shift,
    )


def together(
    readings: Readings, segment: IntArray, rows: IntArray, *, whole: bool
) -> Iterator[IntArray]:
    """Yield which of some readings are of one sensor and one segment.

    Unless they may stay ``whole``, there are no more than can be whitened together; readings come
    in order of time.
    """
    keys = np.column_stack([readings.sensor[rows], segment[rows], readings.stamp_ns[rows]])
    order = np.lexsort(keys.T[::-1])
    starts = np.flatnonzero(np.diff(keys[order, :2], axis=0).any(axis=1)) + 1
    for part in np.split(order, starts):
        if len(part):
            yield from [part] if whole else np.array_split(part, -(-len(part) // MOST))
