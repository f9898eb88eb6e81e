"""A calibration beside readings that it did not see: what is no longer right, and by how much."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

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
    """A sensor as a calibration has it on a drive through a map.

    Attributes
    ----------
    readings
        As recorded; what follows recorded numbers is taken off.
    trajectory
        The lidar's poses.
    known
        The calibration.
    field_map
        The map.
    options
        Of the solve: the loss, how long errors of poses last, how many readings are needed.
    """

    readings: Readings
    trajectory: Trajectory
    known: KnownCalibration
    field_map: QueryableMap
    options: OneKeyOptions

    @cached_property
    def timed(self) -> Readings:
        """The readings with their poses at the time offset of the calibration."""
        moved = with_offsets(self.readings, self.trajectory, self.known.vector[15:])
        # of a vehicle at rest nothing is known of its motion
        return moved if self.readings.motion is not None else replace(moved, motion=None)

    @property
    def places(self) -> FloatArray:
        """Where the sensor was at them in the map in metres, shape (N, 3)."""
        return np.asarray(self.timed.R_map_lidar @ self.known.vector[:3] + self.timed.p_map_lidar)

    def inside(self) -> BoolArray:
        """Return which readings lie inside the map, shape (N,)."""
        return self.field_map.query(self.places).inside

    def usable(self) -> BoolArray:
        """Return those inside the map that one distortion explains beside the others, (N,)."""
        sample = self.field_map.query(self.places)
        within = sample.inside.copy()
        rows = np.flatnonzero(within)
        own = self.timed[rows]
        wrong = ~plausible(own, sample.select(within), self.options.robust)
        if wrong.any():
            variance = sample.variance[rows].mean(axis=1)
            e = residuals(own, self.field_map, self.known.estimate())
            stretches = grown(wrong, e, median_noise(e, variance), variance)
            # what would leave little to judge by is no stretch
            wrong = stretches if 2 * (~stretches).sum() > (~wrong).sum() else wrong
        within[rows[wrong]] = False
        return within

    def changed(self, change: FloatArray) -> "SensorDrive":
        """Return the sensor after a change of its calibration, shape (16,)."""
        return replace(
            self, known=replace(self.known, vector=changed_vector(self.known.vector, change))
        )


@dataclass(frozen=True)
class FollowedChange:
    """Where a change was followed to.

    Attributes
    ----------
    likelihood
        Of a change in the coordinates of ``COLUMNS``, the calibration's own errors marginalised.
    parts
        That have changed, the plainest first.
    change, covariance
        Their coordinates, part by part.
    used
        Which readings count: inside the map, and explained beside the others, shape (N,).
    """

    likelihood: ChangeLikelihood
    parts: tuple[CalibrationPart, ...]
    change: FloatArray
    covariance: FloatArray
    used: BoolArray


@dataclass(frozen=True)
class Recheck(FollowedChange):
    """A calibration, tested on a drive.

    Attributes
    ----------
    freedom
        Degrees of freedom of the innovation, and of that of the parameters.
    spread
        Covariance of the calibration, with wide variances for what it leaves open, shape (16, 16).
    """

    freedom: tuple[int, int]
    spread: FloatArray


def recheck(drive: SensorDrive, covariance: FloatArray, chance: float) -> Recheck:
    """Test a calibration on a drive.

    A change is followed by Gauss-Newton steps from where it was found: a place that is off by
    centimetres in a steep field is not where the map's gradient at the calibrated place puts it.

    Parameters
    ----------
    drive
        The sensor with its calibration.
    covariance
        Of the calibration; infinite variances for what it leaves open, shape (16, 16).
    chance
        Of calling a change what is none.
    """
    spread = finite(covariance, drive.options)
    followed = _followed(drive, spread, chance)
    likelihood, used = followed.likelihood, followed.used
    if followed.parts:
        used = used & drive.inside()
        if used.sum() < drive.options.min_readings:
            used = drive.usable()
        likelihood = _likelihood(drive, drive, NO_CHANGE, used, spread)
    # What is open takes a degree of freedom, unless readings do not depend on it, as on a clock
    # where motion is not known. (All depend on C, where coordinates are not the parameters.)
    matters = np.linalg.norm(likelihood.root, axis=0) > 0
    open_ = int(np.sum(~np.isfinite(np.diag(covariance)) & matters))
    freedom = 3 * int(used.sum()) - open_, int(matters.sum()) - open_
    change = followed.parts, followed.change, followed.covariance
    return Recheck(likelihood, *change, used, freedom, spread)


def _followed(drive: SensorDrive, spread: FloatArray, chance: float) -> FollowedChange:
    change, used = NO_CHANGE, drive.usable()
    last, here = np.empty(0), drive
    parts: tuple[CalibrationPart, ...] = ()
    # Gauss-Newton: linearise about the changed calibration, test and estimate the change anew.
    for _ in range(ROUNDS):
        likelihood = _likelihood(drive, here, change, used, spread)
        before, parts = parts, parts_changed(likelihood, 3 * int(used.sum()), chance)
        columns = columns_of(parts)
        found = FollowedChange(likelihood, parts, *likelihood.estimate(columns), used)
        if parts == before and _settled(found.change - last, found.covariance):
            break
        last = found.change
        change = limited(columns, found.change)
        here = drive.changed(change)
        seen = here.usable()
        if seen.sum() < drive.options.min_readings:
            break
        used = seen
    return found


def _settled(step: FloatArray, covariance: FloatArray) -> bool:
    sigma = np.sqrt(np.diag(covariance))
    return bool((np.abs(step) <= SETTLED_SIGMAS * sigma).all())


def _likelihood(
    drive: SensorDrive, here: SensorDrive, change: FloatArray, used: BoolArray, spread: FloatArray
) -> ChangeLikelihood:
    """Return the likelihood of a change of a calibration, linearised where it was followed to."""
    basis, lasting_s = changes_of(drive.known.C, change), drive.options.pose_noise.lasting_s
    readings = here.timed.select(used)
    found = change_likelihood((readings,), drive.field_map, (here.known,), lasting_s)
    return marginalise_calibration(found.recentred(basis @ change), spread, basis)


def left_by(found: Recheck, drive: SensorDrive) -> float:
    """Return the squared innovation that the changes of a test do not explain."""
    columns = columns_of(found.parts)
    change = limited(columns, found.change)
    likelihood = _likelihood(drive, drive.changed(change), change, found.used, found.spread)
    return likelihood.squared - likelihood.explained(columns)


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
