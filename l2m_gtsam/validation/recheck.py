"""A calibration beside readings that it did not see: what is no longer right, and by how much."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.trust import plausible, residuals
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, Readings, Trajectory
from l2m_gtsam.qa.metrics.coordinates import (
    COLUMNS,
    NO_CHANGE,
    PARAMETERS,
    changed_vector,
    changes_of,
    columns_of,
)
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.records.validation import CalibrationPart
from l2m_gtsam.solve.robust import grown, median_noise
from l2m_gtsam.validation.innovation import (
    OPEN_SIGMAS,
    ChangeLikelihood,
    KnownCalibration,
    change_likelihood,
    marginalise_calibration,
    parts_changed,
)

ROUNDS = 8
SETTLED_SIGMAS = 0.05
FURTHEST_M, LONGEST_S = 1.0, 0.25  # that a change is followed


@dataclass(frozen=True)
class SensorDrive:
    """Readings of one sensor, and the poses that go with them.

    Attributes
    ----------
    readings
        As recorded; what follows recorded numbers is taken off.
    trajectory
        The lidar's poses.
    """

    readings: Readings
    trajectory: Trajectory

    def at(self, offset: float) -> Readings:
        """Return the readings with their poses at a time offset in seconds."""
        moved = with_offsets(self.readings, self.trajectory, np.array([offset]))
        # of a vehicle at rest nothing is known of its motion
        return moved if self.readings.motion is not None else replace(moved, motion=None)


@dataclass(frozen=True)
class Recheck:
    """A calibration, tested on a drive.

    Attributes
    ----------
    likelihood
        Of a change in the coordinates of ``COLUMNS``, the calibration's own errors marginalised.
    freedom
        Degrees of freedom of the innovation, and of that of the parameters.
    parts
        That have changed, the plainest first.
    change, covariance
        Their coordinates, part by part.
    used
        Which readings count: inside the map, and explained beside the others, shape (N,).
    spread
        Covariance of the calibration, with wide variances for what it leaves open, shape (16, 16).
    """

    likelihood: ChangeLikelihood
    freedom: tuple[int, int]
    parts: tuple[CalibrationPart, ...]
    change: FloatArray
    covariance: FloatArray
    used: BoolArray
    spread: FloatArray


def recheck(
    drive: SensorDrive,
    field_map: QueryableMap,
    known: KnownCalibration,
    covariance: FloatArray,
    options: OneKeyOptions,
    chance: float,
) -> Recheck:
    """Test a calibration on a drive.

    A change is followed by Gauss-Newton steps from where it was found: a place that is off by
    centimetres in a steep field is not where the map's gradient at the calibrated place puts it.

    Parameters
    ----------
    drive
        Readings of the sensor.
    known, covariance
        The calibration; infinite variances for what it leaves open, shape (16, 16).
    options
        Of the solve: the loss, how long errors of poses last, how many readings are needed.
    chance
        Of calling a change what is none.
    """
    spread, basis = finite(covariance, options), changes_of(known.vector[3:12].reshape(3, 3))
    followed = _followed(drive, field_map, known, spread, options, chance)
    likelihood, used = followed.likelihood, followed.used
    if followed.parts:
        used = used & inside(drive, field_map, known)
        if used.sum() < options.min_readings:
            used = usable(drive, field_map, known, options)
        likelihood = about(drive, field_map, known, used, options)
        likelihood = marginalise_calibration(likelihood, spread, basis)
    # What is open takes a degree of freedom, unless readings do not depend on it, as on a clock
    # where motion is not known. (All depend on C, where coordinates are not the parameters.)
    matters = np.linalg.norm(likelihood.root, axis=0) > 0
    open_ = int(np.sum(~np.isfinite(np.diag(covariance)) & matters))
    freedom = 3 * int(used.sum()) - open_, int(matters.sum()) - open_
    return Recheck(
        likelihood, freedom, followed.parts, followed.change, followed.covariance, used, spread
    )


@dataclass(frozen=True)
class _Followed:
    """Where a change was followed to: its parts, their coordinates and the likelihood there."""

    likelihood: ChangeLikelihood
    parts: tuple[CalibrationPart, ...]
    change: FloatArray
    covariance: FloatArray
    used: BoolArray


def _followed(
    drive: SensorDrive,
    field_map: QueryableMap,
    known: KnownCalibration,
    spread: FloatArray,
    options: OneKeyOptions,
    chance: float,
) -> _Followed:
    C, change = known.vector[3:12].reshape(3, 3), NO_CHANGE
    used = usable(drive, field_map, known, options)
    last, here = np.empty(0), known
    parts: tuple[CalibrationPart, ...] = ()
    # Gauss-Newton: linearise about the changed calibration, test and estimate the change anew.
    for _ in range(ROUNDS):
        basis = changes_of(C, change)
        likelihood = about(drive, field_map, here, used, options).recentred(basis @ change)
        likelihood = marginalise_calibration(likelihood, spread, basis)
        before, parts = parts, parts_changed(likelihood, 3 * int(used.sum()), chance)
        columns = columns_of(parts)
        found = _Followed(likelihood, parts, *likelihood.estimate(columns), used)
        if parts == before and _settled(found.change - last, found.covariance):
            break
        last = found.change
        change = limited(columns, found.change)
        here = replace(known, vector=changed_vector(known.vector, change))
        seen = usable(drive, field_map, here, options)
        if seen.sum() < options.min_readings:
            break
        used = seen
    return found


def _settled(step: FloatArray, covariance: FloatArray) -> bool:
    sigma = np.sqrt(np.diag(covariance))
    return bool((np.abs(step) <= SETTLED_SIGMAS * sigma).all())


def about(
    drive: SensorDrive,
    field_map: QueryableMap,
    here: KnownCalibration,
    used: BoolArray,
    options: OneKeyOptions,
) -> ChangeLikelihood:
    """Return the likelihood of a change of a calibration, linearised there."""
    readings = drive.at(float(here.vector[15])).select(used)
    return change_likelihood((readings,), field_map, (here,), options.pose_noise.lasting_s)


def left_by(
    found: Recheck,
    drive: SensorDrive,
    field_map: QueryableMap,
    known: KnownCalibration,
    options: OneKeyOptions,
) -> float:
    """Return the squared innovation that the changes of a test do not explain."""
    columns = columns_of(found.parts)
    change = limited(columns, found.change)
    here = replace(known, vector=changed_vector(known.vector, change))
    basis = changes_of(known.vector[3:12].reshape(3, 3), change)
    likelihood = about(drive, field_map, here, found.used, options).recentred(basis @ change)
    likelihood = marginalise_calibration(likelihood, found.spread, basis)
    return likelihood.squared - likelihood.explained(columns)


def inside(drive: SensorDrive, field_map: QueryableMap, known: KnownCalibration) -> BoolArray:
    """Return which readings lie inside the map, shape (N,)."""
    readings = drive.at(float(known.vector[15]))
    places = readings.R_map_lidar @ known.vector[:3] + readings.p_map_lidar
    return field_map.query(places).inside


def usable(
    drive: SensorDrive, field_map: QueryableMap, known: KnownCalibration, options: OneKeyOptions
) -> BoolArray:
    """Return the readings inside the map that one distortion explains beside the others, (N,)."""
    readings = drive.at(float(known.vector[15]))
    sample = field_map.query(readings.R_map_lidar @ known.vector[:3] + readings.p_map_lidar)
    within = sample.inside.copy()
    rows = np.flatnonzero(within)
    own = readings[rows]
    wrong = ~plausible(own, sample.select(within), options.robust)
    if wrong.any():
        variance = sample.variance[rows].mean(axis=1)
        e = residuals(own, field_map, known.estimate())
        stretches = grown(wrong, e, median_noise(e, variance), variance)
        # what would leave little to judge by is no stretch
        wrong = stretches if 2 * (~stretches).sum() > (~wrong).sum() else wrong
    within[rows[wrong]] = False
    return within


def finite(covariance: FloatArray, options: OneKeyOptions) -> FloatArray:
    """Return a covariance with wide variances for what is open."""
    wide = OPEN_SIGMAS * np.append(options.rank.scale(), options.rank.useful_offset_s)
    known = np.isfinite(np.diag(covariance))
    spread = np.where(known[:, None] & known, covariance, 0.0)
    return np.asarray(spread + np.diag(np.where(known, 0.0, wide**2)))


def limited(columns: Sequence[int], values: FloatArray) -> FloatArray:
    """Return coordinates of a change, shape (16,), no larger than can be followed."""
    change = np.zeros(PARAMETERS)
    change[columns] = values
    most = np.full(PARAMETERS, np.inf)
    most[COLUMNS[CalibrationPart.PLACE]] = FURTHEST_M
    most[COLUMNS[CalibrationPart.CLOCK]] = LONGEST_S
    return np.asarray(np.clip(change, -most, most))
