"""Whether sensors moved together: one displacement of the lidar, or of the frame of its poses.

Sensors that moved alike against the lidar were hardly all knocked off their mounts: the lidar's
mount gave way, or poses are given in another frame than the map. Either is one rigid motion of all
poses. It is tested in the readings of all sensors together: each by itself need not show it, as a
frame that is displaced looks like no change of a sensor where the vehicle turns. Then it is
followed by Gauss-Newton steps, with the calibrations held to their covariances, each sensor is
tested at the displaced poses, and the whole stands beside what else explains the same readings,
each with what its parameters cost.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from l2m_factors import skew
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.coverage import errors_over_stated
from l2m_gtsam.data import BoolArray, FloatArray, Readings, RigidTransform, Trajectory
from l2m_gtsam.qa.metrics.changes import MISSED
from l2m_gtsam.qa.metrics.coordinates import PARAMETERS, width
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.places import CLEAR
from l2m_gtsam.records.validation import (
    CalibrationPart,
    DetectableShift,
    Displaced,
    Displacement,
)
from l2m_gtsam.solve.chi_square import chance_beyond, noticed_sigmas
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
)

FREEDOMS = 6
TURN, SHIFT = range(3), range(3, 6)
COLUMNS = (tuple(SHIFT), tuple(TURN), (*TURN, *SHIFT))  # that a displacement may have
FURTHEST_RAD = 0.5  # that it is followed


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
    drives, spreads
        S sensors in one map, and covariances of their calibrations, (16, 16) and finite.
    alike
        Share of each covariance that errors have which the calibrations of several sensors may
        have in common, as those of map and poses.
    """

    drives: tuple[SensorDrive, ...]
    spreads: tuple[FloatArray, ...]
    alike: tuple[float, ...]

    @property
    def known(self) -> list[KnownCalibration]:
        """Their calibrations."""
        return [drive.known for drive in self.drives]

    @property
    def options(self) -> OneKeyOptions:
        """Of the solve."""
        return self.drives[0].options

    def displaced(self, by: PoseDisplacement) -> "SensorsOnDrive":
        """Return them with poses that are displaced."""
        moved = (replace(d, trajectory=by.applied(d.trajectory)) for d in self.drives)
        return replace(self, drives=tuple(moved))

    def usable(self) -> list[BoolArray]:
        """Return which readings of each sensor count."""
        return [drive.usable() for drive in self.drives]

    def likelihood(
        self, counting: Sequence[BoolArray], *here: PoseDisplacement
    ) -> ChangeLikelihood:
        """Return the likelihood of further displacements, each of poses displaced so far.

        Of each sensor the readings that are ``counting``, as of ``usable``, are taken.
        """
        each = zip(self.drives, counting, strict=True)
        parts = [drive.timed.select(used) for drive, used in each]
        field_map = self.drives[0].field_map
        whole = change_likelihood(
            parts,
            field_map,
            self.known,
            self.options.pose_noise.lasting_s,
            lambda readings: np.concatenate([by.features(readings) for by in here], axis=2),
            # What a map is wrong by beyond what it states is alike for all sensors.
            errors_over_stated(field_map),
        )
        # Displacements are the last coordinates, behind those of the calibrations.
        free = FREEDOMS * len(here)
        behind = np.vstack([np.zeros((PARAMETERS * len(parts), free)), np.eye(free)])
        return marginalise_calibration(whole, self._largest_covariance(), behind)

    def _largest_covariance(self) -> FloatArray:
        """Return what the covariance of all calibrations together is no larger than.

        How errors of two sensors are correlated is in no file. Whatever it is, those of S that may
        be alike are no larger than S times as large and not correlated (Cauchy and Schwarz).
        """
        count = len(self.spreads)
        each = zip(self.spreads, self.alike, strict=True)
        return np.asarray(block_diag(*(P * (1 - a + count * a) for P, a in each)))

    def rechecked(self, chance: float) -> list[Recheck]:
        """Return a test of each sensor."""
        each = zip(self.drives, self.spreads, strict=True)
        return [recheck(drive, P, chance) for drive, P in each]

    def left(self, tests: Sequence[Recheck]) -> float:
        """Return the squared innovation that tests' changes do not explain.

        A reading that does not count leaves as much as the largest one that does: else what
        rejects most would explain best.
        """
        rejected = sum(np.sum(~test.used) for test in tests)
        return float(rejected) * self.options.robust.largest + sum(
            left_by(*each) for each in zip(tests, self.drives, strict=True)
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
        counting = displaced.usable()
        if min(used.sum() for used in counting) < sensors.options.min_readings:
            return None
        likelihood = displaced.likelihood(counting, here).recentred(here.vector)
        price = np.log(3 * sum(used.sum() for used in counting))
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


@dataclass(frozen=True)
class DisplacementTest:
    """The test of displacements of lidar and frame in the readings of all sensors.

    Attributes
    ----------
    starts
        Displacements by nothing.
    likelihood
        Of one of each, one after the other.
    price
        What each number of a displacement has to explain (the BIC).
    """

    starts: tuple[PoseDisplacement, ...]
    likelihood: ChangeLikelihood
    price: float

    @classmethod
    def of(cls, sensors: SensorsOnDrive) -> "DisplacementTest":
        """Test sensors; of a single one a displacement of the lidar is its own."""
        middles = {
            Displaced.LIDAR: np.mean([each.vector[:3] for each in sensors.known], axis=0),
            Displaced.FRAME: sensors.drives[0].trajectory.p.mean(axis=0),
        }
        starts = tuple(
            PoseDisplacement(of, at, np.zeros(FREEDOMS))
            for of, at in middles.items()
            if of is Displaced.FRAME or len(sensors.known) > 1
        )
        counting = sensors.usable()
        count = sum(int(used.sum()) for used in counting)
        return cls(starts, sensors.likelihood(counting, *starts), float(np.log(3 * count)))

    def shown(self, chance: float) -> list[PoseDisplacement]:
        """Return those that explain more than chance does, and than they cost."""
        return [
            start
            for k, start in enumerate(self.starts)
            if any(
                chance_beyond(self.likelihood.explained(at), len(at)) < self._least(len(at), chance)
                for at in self._columns(k)
            )
        ]

    def detectable(self, chance: float) -> tuple[DetectableShift, ...]:
        """Return the smallest shifts that are shown."""
        sigmas = noticed_sigmas(len(SHIFT), self._least(len(SHIFT), chance), MISSED)
        found = []
        for k, start in enumerate(self.starts):
            shift, *_ = self._columns(k)
            least = float(np.linalg.svd(self.likelihood.root[:, shift], compute_uv=False)[-1])
            found.append(DetectableShift(start.of, sigmas / least if least > 0 else float("inf")))
        return tuple(found)

    def _least(self, freedom: int, chance: float) -> float:
        """Return how seldom chance has to do as much as a displacement with so many numbers."""
        each = chance / (len(self.starts) * len(COLUMNS))  # Bonferroni
        return min(each, float(chance_beyond(freedom * self.price, freedom)))

    def _columns(self, start: int) -> list[list[int]]:
        return [[FREEDOMS * start + k for k in at] for at in COLUMNS]


@dataclass(frozen=True)
class ExplainedDrive:
    """Sensors on a drive after something that explains their readings, and what is left of them.

    Attributes
    ----------
    sensors
        Beside that.
    tests
        Of each.
    parameters
        How many numbers describe what happened, with the parts of sensors that changed besides.
    """

    sensors: SensorsOnDrive
    tests: tuple[Recheck, ...]
    parameters: int

    @classmethod
    def by(cls, sensors: SensorsOnDrive, freedom: int, chance: float) -> "ExplainedDrive":
        """Test sensors beside what so many numbers describe."""
        tests = tuple(sensors.rechecked(chance))
        return cls(sensors, tests, freedom + sum(map(width, parts_of(tests))))

    @cached_property
    def score(self) -> float:
        """What is left, and what the parameters cost (the BIC)."""
        price = np.log(3 * sum(len(each.used) for each in self.tests))
        return self.sensors.left(self.tests) + float(price) * self.parameters


def common_displacement(
    sensors: SensorsOnDrive,
    test: DisplacementTest,
    chance: float,
    others: Callable[[], Sequence[ExplainedDrive]],
) -> tuple[PoseDisplacement, Displacement] | None:
    """Return the displacement that all sensors share, as poses take it and as it is reported.

    None where something else explains their readings as well.

    Parameters
    ----------
    sensors
        Of one vehicle.
    test
        Of them.
    chance
        Of calling a change what is none.
    others
        Asked for what else may explain them, beside changes of single sensors.
    """
    found = [
        each
        for each in (followed(sensors, start) for start in test.shown(chance))
        if each is not None
    ]
    if not found:
        return None
    alone = ExplainedDrive.by(sensors, 0, chance)
    shared = [
        ExplainedDrive.by(sensors.displaced(each.displacement), len(each.columns), chance)
        for each in found
    ]
    best = min(each.score for each in shared)
    # Where no sensor has changed, the test of the displacement has decided.
    changed = any(each.parts for each in alone.tests)
    if best > (alone.score - CLEAR if changed else np.inf):
        return None
    if any(each.score <= best for each in others()):
        return None
    good = [k for k, each in enumerate(shared) if each.score - best < CLEAR]
    told = found[min(good)]  # of two that explain as much the lidar's, which stands first
    of = tuple(found[k].displacement.of for k in good)
    return told.displacement, told.record(of, alone.score - best)


def parts_of(tests: Sequence[Recheck]) -> list[CalibrationPart]:
    """Return the parts of all sensors that changed, one after the other."""
    return list(chain.from_iterable(each.parts for each in tests))
