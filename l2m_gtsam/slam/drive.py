"""A drive to be localised: odometry, readings and scans on key poses, calibrations, a start."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import Calibrations, KeyPoseReadings
from l2m_gtsam.data import FloatArray, IntArray, RigidTransform
from l2m_gtsam.recording.odometry_jumps import Jump, RepairedOdometry
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.links import Links
from l2m_gtsam.slam.odometry import OdometrySteps
from l2m_gtsam.slam.options import DriftOptions

# Of the first pose, rad^2 and m^2, where no start is given: it defines the frame of the poses.
EXACT_START = np.diag(np.repeat([1e-4, 1e-3], 3) ** 2)
STANDING_M_S = 1e-3  # path that a second adds: what lasts over a path does not last for ever


@dataclass(frozen=True)
class KnownSensors:
    """Calibrations of the S sensors of a drive.

    Attributes
    ----------
    names
        In the order that readings count sensors.
    t, distortion, offset
        Position in metres (S, 3), C row by row and H in uT (S, 12), clock offset in seconds (S,).
    noise
        Standard deviation of each sensor's noise in uT, shape (S,).
    covariance
        Of (t, C row by row, H) in m and uT, shape (S, 15, 15).
    """

    names: tuple[str, ...]
    t: FloatArray
    distortion: FloatArray
    offset: FloatArray
    noise: FloatArray
    covariance: FloatArray

    def vectors(self) -> FloatArray:
        """Return (t, C row by row, H) of each, shape (S, 15)."""
        return np.hstack([self.t, self.distortion])

    def at(self, vectors: FloatArray) -> "KnownSensors":
        """Return them with other estimates of (t, C row by row, H), shape (S, 15)."""
        return replace(self, t=vectors[:, :3], distortion=vectors[:, 3:])

    def loosened(self, distortion: float, offset: float | FloatArray) -> "KnownSensors":
        """Return them with less certain C, and H in uT: by these standard deviations more.

        ``offset`` is that of all sensors, or of each, shape (S,).
        """
        more = np.zeros((len(self.names), 15))
        more[:, 3:12], more[:, 12:] = distortion**2, np.reshape(offset, (-1, 1)) ** 2
        return replace(self, covariance=self.covariance + more[:, :, None] * np.eye(15))

    def corrected(self, correction: FloatArray) -> "KnownSensors":
        """Return one sensor whose field is ``A b + h`` where now it is b, of (A row by row, h)."""
        A, h = correction[:9].reshape(3, 3), correction[9:]
        C = np.linalg.solve(A.T, self.distortion[0, :9].reshape(3, 3).T).T
        H = self.distortion[0, 9:] - C @ h
        return replace(self, distortion=np.append(C.ravel(), H)[None])

    def fixed(self) -> Calibrations:
        """Return them as constants of factors."""
        return Calibrations(self.t, self.distortion, self.offset)


@dataclass(frozen=True)
class StartPose:
    """Where a drive begins in the map.

    Attributes
    ----------
    T_map_lidar
        Pose of the lidar at the first key pose.
    covariance
        Of a right perturbation, rotation (rad) before translation (m), shape (6, 6).
    """

    T_map_lidar: RigidTransform
    covariance: FloatArray

    @property
    def defines_frame(self) -> bool:
        """Whether poses are relative to it, so that it has no error."""
        return np.array_equal(self.covariance, EXACT_START)


@dataclass(frozen=True)
class OdometryJump:
    """A step in which odometry jumps.

    Attributes
    ----------
    step
        Its number.
    jump
        What odometry recorded there.
    covariance
        Of a right perturbation of the recorded step if it is motion, (6, 6).
    """

    step: int
    jump: Jump
    covariance: FloatArray


@dataclass(frozen=True)
class Drive:
    """A drive to be localised.

    Attributes
    ----------
    stamp_ns
        Times of the K key poses, shape (K,).
    steps
        Odometry between them, K - 1 steps.
    readings
        N readings in order of key poses, each taken between its key pose and the next.
    start
        Prior of the first key pose.
    sensors
        Calibrations of the S sensors.
    reading_ns
        Times of the N readings, shape (N,).
    links
        L scan registrations of key poses.
    jumps
        Steps that continue the motion around them, for odometry jumps there.
    """

    stamp_ns: IntArray
    steps: OdometrySteps
    readings: KeyPoseReadings
    start: StartPose
    sensors: KnownSensors
    reading_ns: IntArray
    links: Links = field(default_factory=Links.none)
    jumps: tuple[OdometryJump, ...] = ()

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def progress(self) -> FloatArray:
        """Path to each of the K key poses by odometry, shape (K,), metres; see ``STANDING_M_S``."""
        standing = STANDING_M_S * 1e-9 * (self.stamp_ns - self.stamp_ns[0])
        return np.asarray(self.steps.path + standing)

    @property
    def progress_at_readings(self) -> FloatArray:
        """The same of the N readings, shape (N,)."""
        progress, key = self.progress, self.readings.key_pose
        return np.asarray(progress[key] + self.readings.fraction * np.diff(progress)[key])

    def until(self, count: int) -> "Drive":
        """Return the drive as it is up to so many key poses."""
        links = self.links.key_pose < count
        rows = np.flatnonzero(self.readings.key_pose < count - 1)
        return replace(
            self,
            stamp_ns=self.stamp_ns[:count],
            steps=self.steps.until(count - 1),
            readings=self.readings[rows],
            reading_ns=self.reading_ns[rows],
            links=self.links[links],
            jumps=tuple(each for each in self.jumps if each.step < count - 1),
        )

    def dead_reckoning(self) -> list[gtsam.Pose3]:
        """Return the key poses by odometry alone, from the start on."""
        poses = [as_pose(self.start.T_map_lidar)]
        for step in range(len(self.steps)):
            poses.append(poses[-1].compose(self.step(step)))
        return poses

    def step(self, number: int, scale_error: float = 0.0) -> gtsam.Pose3:
        """Return odometry's step from a key pose to the next, its length corrected for an error."""
        return gtsam.Pose3(
            gtsam.Rot3(self.steps.R[number]), (1 + scale_error) * self.steps.p[number]
        )

    def as_recorded(self, jumps: Sequence[OdometryJump]) -> "Drive":
        """Return the drive with the recorded steps where odometry jumps."""
        R, p, covariance = self.steps.R.copy(), self.steps.p.copy(), self.steps.covariance.copy()
        for each in jumps:
            R[each.step], p[each.step] = each.jump.recorded.R, each.jump.recorded.t
            covariance[each.step] = each.covariance
        return replace(self, steps=replace(self.steps, R=R, p=p, covariance=covariance))

    @property
    def drifts(self) -> FloatArray | None:
        """What a unit of the steady drift adds to each step; see ``OdometrySteps.drifts``."""
        return self.steps.drifts(self.start.T_map_lidar.R @ self.steps.up_start)

    def as_walk(self, over_m: float) -> "Drive":
        """Return the drive for solvers of poses alone; see ``OdometrySteps``."""
        return replace(self, steps=self.steps.as_walk(over_m))

    def with_scale_as_drift(self, over_m: float) -> "Drive":
        """Return the drive for solvers without a scale variable; see ``OdometrySteps``."""
        return replace(self, steps=self.steps.with_scale_as_drift(over_m))

    def without_drift(self, drift: FloatArray | None, poses: list[gtsam.Pose3]) -> "Drive":
        """Return the drive without a steady drift of its odometry.

        Parameters
        ----------
        drift
            In its standard deviations, along the axes of the poses, shape (8,); None for none.
        poses
            K key poses.
        """
        drifts = self.drifts
        if drift is None or drifts is None:
            return self
        turned, added = np.hsplit(drifts @ drift, 2)
        R, _ = stacked(poses[:-1])
        own, fixed = np.einsum("nji,nj->ni", R, added), self.steps.fixed_axes
        if fixed is not None:
            fixed = fixed - added @ self.start.T_map_lidar.R
        back = Rotation.from_rotvec(-np.einsum("nji,nj->ni", R, turned)).as_matrix()
        steps = replace(
            self.steps,
            R=back @ self.steps.R,
            p=self.steps.p - own,
            fixed_axes=fixed,
            steady=None,
            turning=None,
        )
        return replace(self, steps=steps)


def odometry_jumps(
    repaired: RepairedOdometry, rows: IntArray, options: DriftOptions
) -> tuple[OdometryJump, ...]:
    """Return the steps between key poses in which odometry jumps.

    Parameters
    ----------
    repaired
        Odometry.
    rows
        Rows of the key poses in it, shape (K,); those before and after each jump are among them.
    options
        Drift of odometry.
    """
    return tuple(
        OdometryJump(
            int(np.searchsorted(rows, each.row)),
            each,
            drift_covariance(each.recorded.R[None], each.recorded.t[None], options)[0],
        )
        for each in repaired.jumps
    )


def as_pose(transform: RigidTransform) -> gtsam.Pose3:
    """Return a transform as GTSAM's pose."""
    return gtsam.Pose3(gtsam.Rot3(transform.R), transform.t)


def stacked(poses: Sequence[gtsam.Pose3]) -> tuple[FloatArray, FloatArray]:
    """Return rotations (K, 3, 3) and positions (K, 3) in metres."""
    R = np.stack([pose.rotation().matrix() for pose in poses])
    return R, np.stack([pose.translation() for pose in poses])


def as_poses(R: FloatArray, p: FloatArray) -> list[gtsam.Pose3]:
    """Return the poses of ``stacked`` rotations and positions."""
    return [gtsam.Pose3(gtsam.Rot3(turn), place) for turn, place in zip(R, p, strict=True)]


def as_transform(pose: gtsam.Pose3) -> RigidTransform:
    """Return GTSAM's pose as a transform."""
    return RigidTransform(pose.rotation().matrix(), pose.translation())
