"""Readings of a solve, averaged along the drive, with all that may be wrong in them.

What is asked is whether the *place* changed. Poses that a recording takes for exact would then turn
every error of theirs into a change: they count as wrong by a little at least.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_diag as sparse_block_diag
from scipy.sparse import coo_array, csr_array

from l2m_gtsam.calibration.averages import Averages, AveragingOptions
from l2m_gtsam.calibration.budget.found import Budget
from l2m_gtsam.calibration.budget.processes import ReadingPlaces
from l2m_gtsam.calibration.coverage import Coverage, UncertainMap, cover, errors_over_stated
from l2m_gtsam.calibration.factor_graph import Estimate, batch_readings
from l2m_gtsam.calibration.pose_errors import error_of_poses
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.calibration.view import QueryableMap, View, observe, places_of
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.geometry import isotropic_covariance
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.solve.linear_algebra import RowBlocks, lower_information_root, right_divided

# What is known of a sensor's t, C row by row, H and time offset here: next to nothing, beside what
# the readings of a drive determine.
WIDE = np.array([1.0] * 3 + [1.0] * 9 + [100.0] * 3 + [1.0])


@dataclass(frozen=True)
class AveragedDrive:
    """Averages with what the map predicts for them.

    Attributes
    ----------
    averages
        N of them.
    view
        The same as the solve looks at them.
    estimate
        Of their sensors.
    map_errors
        How many times as large as it states the map's errors count: as large as those at readings
        of its survey that were held out.
    """

    averages: Averages
    view: View
    estimate: Estimate
    map_errors: float

    @property
    def map_variance(self) -> FloatArray:
        """Variance of the map per axis at each average, uT^2, shape (N, 3)."""
        return np.asarray(self.map_errors**2 * self.view.map_variance)

    @classmethod
    def of(cls, averages: Averages, field_map: QueryableMap, estimate: Estimate) -> "AveragedDrive":
        """Return the averages inside the map."""
        view = observe(averages.readings, field_map, estimate, 1)
        kept = Averages(
            view.readings,
            averages.slot[view.rows],
            averages.residual[view.rows],
            averages.counted[view.rows],
            averages.noise,
        )
        return cls(kept, view, estimate, errors_over_stated(field_map))

    def marginal(
        self,
        field_map: QueryableMap,
        errors: UncertainMap,
        budget: Budget,
        options: AveragingOptions,
    ) -> MarginalRows:
        """Return the rows in which sources are looked for.

        Parameters
        ----------
        field_map, errors
            The map, and what it knows of its errors.
        budget
            Processes that the solve found in the readings: they may be here, too.
        options
            How wrong poses are at least.
        """
        readings = self.view.readings
        exact = replace(self.view, readings=replace(readings, pose_root=None, regressors=None))
        coverage = cover(exact, errors, self.estimate, 1.0).with_larger_errors(self.map_errors)
        whitening = slot_whitening(self, field_map, coverage.rest, options)
        design, prior = nuisances(exact.readings, field_map, coverage, self.estimate, budget)
        return MarginalRows(
            points=places_of(readings, self.estimate.t),
            residual=self.averages.residual,
            whitening=whitening,
            nuisance=RowBlocks.of(whitening @ design),
            prior=prior,
            slot=self.averages.slot,
        )


def slot_whitening(
    drive: AveragedDrive, field_map: QueryableMap, rest: FloatArray, options: AveragingOptions
) -> csr_array:
    """Return what makes noise white, slot by slot: readings of one pose share its error.

    Parameters
    ----------
    drive
        N averages.
    field_map
        The map, whose field errors of poses turn and whose gradient they follow.
    rest
        Variance of the map that is each reading's own, per axis in uT^2, shape (N, 3).
    options
        How wrong poses are at least.

    Returns
    -------
    csr_array
        In 1/uT, shape (3 N, 3 N).
    """
    readings, estimate = drive.view.readings, drive.estimate
    R, N = readings.R_map_lidar, len(readings)
    spread = right_divided(R, estimate.C()[readings.sensor])
    spread = readings.noise(drive.averages.noise)[:, None, None] * spread
    own = spread @ spread.transpose(0, 2, 1) + rest[:, :, None] * np.eye(3)
    by_pose = pose_shares(readings, field_map, estimate, options)
    order = np.argsort(drive.averages.slot, kind="stable")
    blocks = np.split(order, np.flatnonzero(np.diff(drive.averages.slot[order])) + 1)
    roots = []
    for rows in blocks:
        F = by_pose[rows].reshape(3 * len(rows), 6)
        covariance = (F @ F.T).reshape(len(rows), 3, len(rows), 3)
        each = np.arange(len(rows))
        covariance[each, :, each] += own[rows]
        roots.append(lower_information_root(covariance.reshape(3 * len(rows), -1)))
    sorted_ = csr_array(sparse_block_diag(roots, format="csr"))
    back = np.empty(N, dtype=np.int64)
    back[order] = np.arange(N)
    columns = (3 * back[:, None] + np.arange(3)).ravel()
    return csr_array(sorted_[:, columns][columns])


def pose_shares(
    readings: Readings, field_map: QueryableMap, estimate: Estimate, options: AveragingOptions
) -> FloatArray:
    """Return what a sigma of each error of a pose does to readings, map frame, uT, (N, 3, 6)."""
    least = isotropic_covariance(options.pose_rotation_deg, options.pose_position_m)
    covariance = np.broadcast_to(least, (len(readings), 6, 6))
    if (root := readings.pose_root) is not None:
        covariance = covariance + root @ root.transpose(0, 2, 1)
    values, axes = np.linalg.eigh(covariance)
    roots = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    F = error_of_poses(replace(readings, pose_root=roots), field_map, estimate)
    return np.asarray(readings.R_map_lidar @ F)


def nuisances(
    readings: Readings,
    field_map: QueryableMap,
    coverage: Coverage,
    estimate: Estimate,
    budget: Budget,
) -> tuple[csr_array, FloatArray]:
    """Return errors that readings share: of the map, its survey's sensors, their own, the drive's.

    Returns
    -------
    design
        What a unit of each does to readings, map frame, uT, shape (3 N, K).
    prior
        Their information beforehand, shape (K, K).
    """
    tiles, suite = len(coverage.lower), len(coverage.spread)
    first = tiles + suite
    last = first + SENSOR * len(readings.sensors)
    beside = process_shares(readings, field_map, estimate, budget)
    size = last + sum(features.shape[2] for _, features in beside)
    starts = dict(zip(coverage.tiles, np.cumsum([0, *coverage.tiles.values()]), strict=False))
    parts = []
    _, gradient = field_map.field_and_gradient(places_of(readings, estimate.t))
    for group in coverage.groups:
        parts.append(_entries(group.rows, int(starts[group.tile]), group.features))
        if suite:
            moved = group.common - gradient[group.rows] @ coverage.shift
            parts.append(_entries(group.rows, tiles, moved))
    for sensor in np.unique(readings.sensor).tolist():
        rows = np.arange(len(readings))[readings.rows_of(sensor)]
        own = sensor_shares(readings, rows, field_map, estimate)
        parts.append(_entries(rows, first + SENSOR * sensor, own))
    at = last
    for rows, features in beside:
        parts.append(_entries(rows, at, features))
        at += features.shape[2]
    prior = np.eye(size)
    prior[:tiles, :tiles] = coverage.tile_information
    prior[range(tiles, first), range(tiles, first)] = coverage.spread**-2
    of_sensors = range(first, last)
    prior[of_sensors, of_sensors] = np.tile(WIDE**-2, len(readings.sensors))
    values, *places = (np.concatenate(each) for each in zip(*parts, strict=True))
    return coo_array((values, tuple(places)), shape=(3 * len(readings), size)).tocsr(), prior


def process_shares(
    readings: Readings, field_map: QueryableMap, estimate: Estimate, budget: Budget
) -> list[tuple[IntArray, FloatArray]]:
    """Return rows of readings and what a sigma of each weight of a process does to them.

    In the map frame in uT, shapes (n,) and (n, 3, m).
    """
    places = ReadingPlaces.of(readings, field_map, estimate)
    shares = []
    for found in budget.found:
        process = found.process.on(places)
        rows = np.arange(len(readings))
        if process.sensor is not None:
            rows = rows[readings.rows_of(process.sensor)]
        features = readings.R_map_lidar[rows] @ process.features(rows)
        shares.append((rows, features * np.sqrt(found.variances)))
    return shares


def sensor_shares(
    readings: Readings, rows: IntArray, field_map: QueryableMap, estimate: Estimate
) -> FloatArray:
    """Return what a unit of each parameter of a sensor does to its readings, map frame.

    In uT per unit of t, C row by row, H and time offset, shape (n, 3, 16).
    """
    own = readings[rows]
    sensor = int(own.sensor[0])
    batch = batch_readings(own, field_map)
    found = batch.residuals(estimate.values([sensor]), sensor)
    J = np.concatenate(batch.jacobians(found), axis=2)
    return np.asarray(right_divided(own.R_map_lidar, estimate.C()[sensor]) @ J)


def with_calibration(rows: MarginalRows, covariances: FloatArray) -> MarginalRows:
    """Return rows whose sensors are as calibrated, to its covariances, shape (S, 16, 16)."""
    prior = rows.prior.copy()
    first = len(prior) - SENSOR * len(covariances)
    for k, covariance in enumerate(covariances):
        own = slice(first + SENSOR * k, first + SENSOR * (k + 1))
        sigma = np.sqrt(np.diag(covariance))
        scaled = covariance / np.outer(sigma, sigma)
        # Nearly singular where a calibration holds directions: as exact as a millionth of a sigma.
        values, axes = np.linalg.eigh(scaled)
        root = axes / np.sqrt(np.maximum(values, 1e-12))
        prior[own, own] = (root @ root.T) / np.outer(sigma, sigma)
    return replace(rows, prior=prior)


def _entries(
    rows: IntArray, first: int, values: FloatArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return values, shape (n, 3, k), of readings from a column on, their rows and columns."""
    n, _, k = values.shape
    at = np.broadcast_to((3 * rows[:, None] + np.arange(3))[:, :, None], (n, 3, k))
    columns = np.broadcast_to(first + np.arange(k), (n, 3, k))
    return values.ravel(), at.ravel(), columns.ravel()
