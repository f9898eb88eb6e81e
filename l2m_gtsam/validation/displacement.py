"""Whether sensors moved together: one displacement of the lidar, or of the frame of its poses.

Sensors that moved alike against the lidar were hardly all knocked off their mounts: the lidar's
mount gave way, or poses are given in another frame than the map. Either is one rigid motion of all
poses. It is followed by Gauss-Newton steps, with the calibrations held to their covariances; then
each sensor is tested at the displaced poses, and the whole stands beside what changes of single
sensors explain of the same readings, each with what its parameters cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import skew
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, Readings, RigidTransform, Trajectory
from l2m_gtsam.qa.metrics.coordinates import PARAMETERS, width
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.places import CLEAR
from l2m_gtsam.records.validation import CalibrationPart, Displaced, Displacement
from l2m_gtsam.validation.innovation import (
    ChangeLikelihood,
    KnownCalibration,
    change_likelihood,
    marginalise_calibration,
)
from l2m_gtsam.validation.recheck import (
    FURTHEST_M,
    ROUNDS,
    SETTLED_SIGMAS,
    Recheck,
    SensorDrive,
    left_by,
    recheck,
    usable,
)

FREEDOMS = 6
TURN, SHIFT = range(3), range(3, 6)
COLUMNS = (tuple(SHIFT), tuple(TURN), (*TURN, *SHIFT))  # that a displacement may have
FURTHEST_RAD = 0.5  # that it is followed
OF_PLACE = {CalibrationPart.PLACE, CalibrationPart.ROTATION}
# Displacements are the last coordinates of a likelihood, behind those of a calibration.
BEHIND = np.vstack([np.zeros((PARAMETERS, FREEDOMS)), np.eye(FREEDOMS)])


@dataclass(frozen=True)
class PoseDisplacement:
    """One rigid motion of all poses.

    Attributes
    ----------
    of
        Whether it is in the lidar's frame, behind each pose, or in that of the map, before it.
    centre
        About which it turns, metres in that frame, shape (3,).
    vector
        Rotation vector in radians, shift in metres, shape (6,).
    """

    of: Displaced
    centre: FloatArray
    vector: FloatArray

    @property
    def transform(self) -> RigidTransform:
        """From poses as they are given to those that the map and the calibration fit."""
        R = Rotation.from_rotvec(self.vector[:3]).as_matrix()
        return RigidTransform(R, self.centre + self.vector[3:] - R @ self.centre)

    def applied(self, poses: Trajectory) -> Trajectory:
        """Return poses that are displaced."""
        by = self.transform
        if self.of is Displaced.LIDAR:
            return replace(poses, R=poses.R @ by.R, p=poses.p + poses.R @ by.t)
        return replace(poses, R=by.R @ poses.R, p=poses.p @ by.R.T + by.t)

    def features(self, readings: Readings) -> FloatArray:
        """Return what a unit of a further displacement is at poses displaced so far, (N, 6, 6)."""
        N = len(readings)
        features = np.zeros((N, FREEDOMS, FREEDOMS))
        if self.of is Displaced.LIDAR:
            features[:] = np.eye(FREEDOMS)
            features[:, 3:, :3] = skew(self.centre[None])
            return features
        back = readings.R_map_lidar.transpose(0, 2, 1)
        features[:, :3, :3] = features[:, 3:, 3:] = back
        features[:, 3:, :3] = -back @ skew(readings.p_map_lidar - self.centre)
        return features


@dataclass(frozen=True)
class SensorsOnDrive:
    """Sensors with their calibrations on a drive.

    Attributes
    ----------
    drives, known, spreads
        Readings, calibrations and covariances, (16, 16) and finite, of S sensors.
    field_map
        The map.
    options
        Of the solve.
    """

    drives: tuple[SensorDrive, ...]
    known: tuple[KnownCalibration, ...]
    spreads: tuple[FloatArray, ...]
    field_map: QueryableMap
    options: OneKeyOptions

    def displaced(self, by: PoseDisplacement) -> "SensorsOnDrive":
        """Return them with poses that are displaced."""
        moved = (replace(d, trajectory=by.applied(d.trajectory)) for d in self.drives)
        return replace(self, drives=tuple(moved))

    def usable(self) -> list[BoolArray]:
        """Return which readings of each sensor count."""
        pairs = zip(self.drives, self.known, strict=True)
        return [usable(drive, self.field_map, known, self.options) for drive, known in pairs]

    def likelihood(self, here: PoseDisplacement) -> ChangeLikelihood:
        """Return the likelihood of a further displacement of poses displaced so far."""
        rows, rest = [], 0.0
        lasting_s = self.options.pose_noise.lasting_s
        each = zip(self.drives, self.known, self.spreads, self.usable(), strict=True)
        for drive, known, spread, used in each:
            readings = drive.at(float(known.vector[15])).select(used)
            whole = change_likelihood(readings, self.field_map, known, lasting_s, here.features)
            own = marginalise_calibration(whole, spread, BEHIND)
            rows.append(np.column_stack([own.root, own.white]))
            rest += own.rest
        found = ChangeLikelihood.of(np.concatenate(rows))
        return replace(found, rest=found.rest + rest)

    def rechecked(self, chance: float) -> list[Recheck]:
        """Return a test of each sensor."""
        each = zip(self.drives, self.known, self.spreads, strict=True)
        return [recheck(d, self.field_map, k, P, self.options, chance) for d, k, P in each]

    def left(self, tests: Sequence[Recheck]) -> float:
        """Return the squared innovation that tests' changes do not explain.

        A reading that does not count leaves as much as the largest one that does: else what
        rejects most would explain best.
        """
        each = zip(tests, self.drives, self.known, strict=True)
        rejected = sum(np.sum(~test.used) for test in tests)
        return float(rejected) * self.options.robust.largest + sum(
            left_by(test, drive, self.field_map, known, self.options) for test, drive, known in each
        )


@dataclass(frozen=True)
class FollowedDisplacement:
    """A displacement where it was followed to, its free coordinates and their covariance."""

    displacement: PoseDisplacement
    columns: tuple[int, ...]
    covariance: FloatArray

    def record(self, of: tuple[Displaced, ...], gain: float) -> Displacement:
        """Return it as it is reported."""
        vector = self.displacement.vector.copy()
        sigma = np.zeros(FREEDOMS)
        sigma[list(self.columns)] = np.sqrt(np.diag(self.covariance))
        vector[:3], sigma[:3] = np.rad2deg(vector[:3]), np.rad2deg(sigma[:3])
        return Displacement(
            of=of,
            shift=row(vector[3:]),
            shift_sigma=row(sigma[3:]),
            turn=row(vector[:3]),
            turn_sigma=row(sigma[:3]),
            gain=gain,
        )


def followed(sensors: SensorsOnDrive, start: PoseDisplacement) -> FollowedDisplacement | None:
    """Return the displacement that explains most, with what it needs and no more.

    None where it leads too far, or out of the map.
    """
    here, last = start, np.full(FREEDOMS, np.inf)
    for _ in range(ROUNDS):
        displaced = sensors.displaced(here)
        if min(used.sum() for used in displaced.usable()) < sensors.options.min_readings:
            return None
        likelihood = displaced.likelihood(here).recentred(here.vector)
        price = np.log(3 * sum(used.sum() for used in displaced.usable()))
        columns = max(COLUMNS, key=lambda at: likelihood.explained(at) - len(at) * price)
        value, covariance = likelihood.estimate(columns)
        if np.max(np.abs(value - last[list(columns)]) / np.sqrt(np.diag(covariance))) < (
            SETTLED_SIGMAS
        ):
            break
        total = np.zeros(FREEDOMS)
        total[list(columns)] = value
        if np.linalg.norm(total[3:]) > FURTHEST_M or np.linalg.norm(total[:3]) > FURTHEST_RAD:
            return None
        last, here = total, replace(here, vector=total)
    return FollowedDisplacement(here, columns, covariance)


def common_displacement(
    sensors: SensorsOnDrive, chance: float
) -> tuple[PoseDisplacement, Displacement] | None:
    """Return the displacement that all sensors share, as poses take it and as it is reported.

    None where changes of single sensors explain their readings as well.

    Parameters
    ----------
    sensors
        Two or more of which changed.
    chance
        Of calling a change what is none.
    """
    poses = sensors.drives[0].trajectory
    middles = {
        Displaced.LIDAR: np.mean([each.vector[:3] for each in sensors.known], axis=0),
        Displaced.FRAME: poses.p.mean(axis=0),
    }
    starts = [PoseDisplacement(of, at, np.zeros(FREEDOMS)) for of, at in middles.items()]
    found = [each for each in (followed(sensors, start) for start in starts) if each is not None]
    every = [sensors, *(sensors.displaced(each.displacement) for each in found)]
    tests = [each.rechecked(chance) for each in every]
    price = np.log(3 * sum(len(each.used) for each in tests[0]))
    freedoms = [0, *(len(each.columns) for each in found)]
    scores = [
        where.left(own) + price * (freedom + sum(map(width, parts_of(own))))
        for where, own, freedom in zip(every, tests, freedoms, strict=True)
    ]
    alone, shared = scores[0], sorted(zip(scores[1:], range(len(found)), strict=True))
    if not shared or shared[0][0] >= alone:
        return None
    good = [k for score, k in shared if score - shared[0][0] < CLEAR]
    told = found[min(good)]  # of two that explain as much the lidar's, which stands first
    of = tuple(found[k].displacement.of for k in sorted(good))
    return told.displacement, told.record(of, float(alone - shared[0][0]))


def parts_of(tests: Sequence[Recheck]) -> list[CalibrationPart]:
    """Return the parts of all sensors that changed, one after the other."""
    return list(chain.from_iterable(each.parts for each in tests))
