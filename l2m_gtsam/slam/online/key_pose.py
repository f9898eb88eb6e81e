"""Key poses as they come: the step from the one before, its readings, its scan registrations.

All estimators on line take these one by one, from a recording (``key_poses_of``) or as a vehicle
drives (:mod:`.intake`). Readings between two key poses come with the second of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from l2m_factors import KeyPoseReadings, drift_weights
from l2m_gtsam.data import FloatArray, IntArray, RigidTransform, joined_rows
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose
from l2m_gtsam.slam.key_pose_readings import joined_readings, no_readings
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.odometry import FixedStep, OdometrySteps
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.slips import SLIPPED

WRONG = float(1 / (1 + np.exp(SLIPPED)))  # how probable a wrong step over a gap is before readings


@dataclass(frozen=True)
class ScanAtKeyPose:
    """A scan that was taken since the key pose before.

    Attributes
    ----------
    points
        In metres in the lidar frame, as if taken at once, shape (N, 3).
    T_key_scan
        The lidar at the scan, by odometry in the frame of the key pose.
    """

    points: FloatArray
    T_key_scan: RigidTransform


@dataclass(frozen=True)
class ArrivedKeyPose:
    """A key pose with what came since the one before.

    Attributes
    ----------
    number
        From 0 on.
    stamp_ns
        Its time.
    R, p
        By odometry in the frame of the key pose before, shapes (3, 3) and (3,), metres.
    covariance
        Of a right perturbation of this step, rotation (rad) before translation (m), shape (6, 6),
        without a steady drift.
    readings
        n readings between both, relative to the one before.
    reading_ns
        Their times, shape (n,).
    links
        Scan registrations of this key pose.
    lost
        Whether odometry has lost the motion to it.
    scans
        That are not registered yet.
    fixed
        The step along fixed axes, where odometry knows it so.
    steady
        Standard deviation of odometry's steady drift along each axis of the frame of the poses as a
        share of the distance, shape (3,). 0 for none.
    turning
        Standard deviation of a steady turning about the third axis of the frame of the poses, along
        the axes of the first key pose, radians per metre, shape (3,). 0 for none.
    recorded
        The same key pose by the step that odometry recorded with its stated error, where that is in
        doubt: this one goes on with the motion before, which is far from it, or is more uncertain,
        as odometry was silent.
    """

    number: int
    stamp_ns: int
    R: FloatArray
    p: FloatArray
    covariance: FloatArray
    readings: KeyPoseReadings
    reading_ns: IntArray
    links: Links
    lost: bool = False
    scans: tuple[ScanAtKeyPose, ...] = ()
    fixed: FixedStep | None = None
    steady: FloatArray = field(default_factory=lambda: np.zeros(3))
    turning: FloatArray = field(default_factory=lambda: np.zeros(3))
    recorded: "ArrivedKeyPose | None" = None

    @property
    def step(self) -> gtsam.Pose3:
        """The step from the key pose before."""
        return gtsam.Pose3(gtsam.Rot3(self.R), self.p)

    @property
    def is_over_gap(self) -> bool:
        """Whether the step is as recorded, and in doubt as odometry was silent over it."""
        recorded = self.recorded
        if recorded is None:
            return False
        return np.array_equal(self.p, recorded.p) and np.array_equal(self.R, recorded.R)

    @property
    def as_recorded(self) -> "ArrivedKeyPose":
        """The same with the step as recorded, where it is in doubt over a gap."""
        if self.recorded is None or not self.is_over_gap:
            return self
        return replace(self.recorded, links=self.links)

    @property
    def as_mixture(self) -> "ArrivedKeyPose":
        """The same with the covariance of both steps by their prior odds, over a gap in doubt."""
        if not self.is_over_gap:
            return self
        one = self.as_recorded
        return replace(one, covariance=one.covariance + WRONG * self.covariance)

    @property
    def length_m(self) -> float:
        """Length of the step in metres."""
        return float(np.linalg.norm(self.p))

    @property
    def steady_m(self) -> FloatArray:
        """What one standard deviation of the drift adds with time and with distance, m, (2, 3).

        All of it comes with distance: with half of it by time the errors on a model ship are the
        same, and the mean speed is not known yet.
        """
        return np.stack([np.zeros(3), self.steady * self.length_m])

    @property
    def drift(self) -> FloatArray:
        """What a unit of each component of the drift adds along the axes of the first key pose.

        Rotation (rad) before translation (m), shape (6, 8), as of ``OdometrySteps.drifts``.
        """
        found = np.zeros((POSE, DRIFT))
        found[:, :POSE] = drift_weights(self.steady_m)
        found[:3, -1] = self.turning * self.length_m
        return found

    def without_readings(self) -> "ArrivedKeyPose":
        """Return it by odometry alone."""
        recorded = None if self.recorded is None else self.recorded.without_readings()
        none = np.empty(0, dtype=np.int64)
        return replace(self, readings=no_readings(), reading_ns=none, recorded=recorded)

    def without_sensor(self, number: int) -> "ArrivedKeyPose":
        """Return it without the readings of one sensor."""
        recorded = None if self.recorded is None else self.recorded.without_sensor(number)
        rows = np.flatnonzero(self.readings.sensor != number)
        readings, stamps = self.readings[rows], self.reading_ns[rows]
        return replace(self, readings=readings, reading_ns=stamps, recorded=recorded)

    @classmethod
    def first(cls, stamp_ns: int, links: Links) -> "ArrivedKeyPose":
        """Return the first key pose of a drive."""
        none = np.empty(0, dtype=np.int64)
        still = np.eye(3), np.zeros(3), np.zeros((POSE, POSE))
        return cls(0, stamp_ns, *still, no_readings(), none, links)


def key_poses_of(drive: Drive) -> Iterator[ArrivedKeyPose]:
    """Yield the key poses of a recorded drive in order."""
    key, links = drive.readings.key_pose, drive.links
    ends = np.searchsorted(key, np.arange(len(drive)))
    order = np.argsort(links.key_pose, kind="stable")
    of_links = np.searchsorted(links.key_pose[order], np.arange(len(drive) + 1))
    for k in range(len(drive)):
        own = links[order[of_links[k] : of_links[k + 1]]]
        stamp = int(drive.stamp_ns[k])
        if k == 0:
            yield ArrivedKeyPose.first(stamp, own)
            continue
        last = len(key) if k == len(drive) - 1 else ends[k]
        rows = np.arange(ends[k - 1], last)
        steps = drive.steps
        yield ArrivedKeyPose(
            k,
            stamp,
            steps.R[k - 1],
            steps.p[k - 1],
            steps.covariance[k - 1],
            drive.readings[rows],
            drive.reading_ns[rows],
            own,
        )


def drive_of(key_poses: Sequence[ArrivedKeyPose], start: StartPose, sensors: KnownSensors) -> Drive:
    """Return key poses, from the first on, as a drive."""
    steps = key_poses[1:]
    shifts = [each.fixed.shift for each in steps if each.fixed is not None]
    steady = np.reshape([each.steady_m for each in steps], (-1, 2, 3))
    turning = np.array([np.linalg.norm(each.turning) * each.length_m for each in steps])
    up_start = start.T_map_lidar.R[2]
    if turning.any():
        axis = steps[0].turning
        up_start = axis / np.linalg.norm(axis)
    return Drive(
        stamp_ns=np.array([each.stamp_ns for each in key_poses], dtype=np.int64),
        steps=OdometrySteps(
            np.reshape([each.R for each in steps], (-1, 3, 3)),
            np.reshape([each.p for each in steps], (-1, 3)),
            np.reshape([each.covariance for each in steps], (-1, POSE, POSE)),
            stated=False,
            fixed_axes=np.stack(shifts) if shifts and len(shifts) == len(steps) else None,
            steady=steady if steady.any() else None,
            turning=np.outer(turning, [0.0, 1.0]) if turning.any() else None,
            up_start=up_start,
        ),
        readings=joined_readings([each.readings for each in key_poses]),
        start=start,
        sensors=sensors,
        reading_ns=np.concatenate([each.reading_ns for each in key_poses]),
        links=joined_rows([each.links for each in key_poses]),
    )


def renumbered(key_pose: ArrivedKeyPose, by: int) -> ArrivedKeyPose:
    """Return a key pose whose number, and those that its readings refer to, are less by this."""
    if not by:
        return key_pose
    number = key_pose.number - by
    readings = replace(key_pose.readings, key_pose=key_pose.readings.key_pose - by)
    links = replace(key_pose.links, key_pose=key_pose.links.key_pose - by)
    recorded = None if key_pose.recorded is None else renumbered(key_pose.recorded, by)
    return replace(key_pose, number=number, readings=readings, links=links, recorded=recorded)
