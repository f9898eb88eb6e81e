"""A drive to be localised: odometry, readings and scans on key poses, calibrations, a start."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import Calibrations, KeyPoseReadings
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings, RigidTransform, Trajectory
from l2m_gtsam.geometry import between, compose, moved
from l2m_gtsam.recording.odometry_jumps import Jump, RepairedOdometry
from l2m_gtsam.recording.sync import interpolated
from l2m_gtsam.records.scans import LoopClosure, PoseFix, ScanEvidence
from l2m_gtsam.slam.odometry import OdometrySteps, drift_covariance
from l2m_gtsam.slam.options import DriftOptions

MAP = -1  # in place of a key pose: the frame of the map
ARM_M = 1.0  # lever arm that converts a rotation into a distance
CREEP_M_S = 1e-6  # makes the progress of a parked vehicle increase with time


@dataclass(frozen=True)
class Links:
    """L scan registrations: poses of key poses in the map, or relative to an earlier key pose.

    Attributes
    ----------
    origin
        Number of the earlier key pose, or ``MAP``, shape (L,).
    key_pose
        Number of the key pose, shape (L,).
    R, p
        Its pose in that frame, shapes (L, 3, 3) and (L, 3), metres.
    covariance
        Of a right perturbation of it, rotation (rad) before translation (m), shape (L, 6, 6).
    """

    origin: IntArray
    key_pose: IntArray
    R: FloatArray
    p: FloatArray
    covariance: FloatArray

    def __len__(self) -> int:
        return len(self.key_pose)

    def __getitem__(self, rows: IntArray | BoolArray) -> "Links":
        return Links(
            self.origin[rows],
            self.key_pose[rows],
            self.R[rows],
            self.p[rows],
            self.covariance[rows],
        )

    @classmethod
    def none(cls) -> "Links":
        """Return the links of a drive without scans."""
        no = np.empty(0, dtype=np.int64)
        return cls(no, no, np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 6, 6)))

    @property
    def in_map(self) -> BoolArray:
        """Which fix a key pose in the map, shape (L,); the others are loop closures."""
        return np.asarray(self.origin == MAP)


def link_stamps(evidence: ScanEvidence) -> IntArray:
    """Return the times of the scans of all links, in nanoseconds."""
    loops = [stamp for each in evidence.loops for stamp in (each.from_ns, each.to_ns)]
    return np.array([*(each.stamp_ns for each in evidence.fixes), *loops], dtype=np.int64)


def key_pose_links(
    evidence: ScanEvidence, trajectory: Trajectory, rows: IntArray, options: DriftOptions
) -> Links:
    """Return scan registrations as links of the key poses nearest in time.

    Odometry connects a scan with its key pose; its drift between the two is added.

    Parameters
    ----------
    evidence
        Fixes and loop closures, at times of the trajectory.
    trajectory
        Odometry, M poses.
    rows
        Rows of the key poses in it, shape (K,).
    options
        Drift of odometry.
    """
    if not len(evidence):
        return Links.none()
    carrier = _Carrier(link_stamps(evidence), trajectory, rows, options)
    fixes = [carrier.fix(each) for each in evidence.fixes]
    loops = [carrier.loop(each) for each in evidence.loops]
    links = [each for each in (*fixes, *loops) if each.origin != each.key_pose]
    return Links(
        origin=np.array([each.origin for each in links], dtype=np.int64),
        key_pose=np.array([each.key_pose for each in links], dtype=np.int64),
        R=np.reshape([each.T.R for each in links], (-1, 3, 3)),
        p=np.reshape([each.T.t for each in links], (-1, 3)),
        covariance=np.reshape([each.covariance for each in links], (-1, 6, 6)),
    )


@dataclass(frozen=True)
class _Link:
    origin: int
    key_pose: int
    T: RigidTransform
    covariance: FloatArray


class _Carrier:
    """Transfers poses and covariances from scans to the key poses nearest in time."""

    def __init__(
        self, stamp_ns: IntArray, trajectory: Trajectory, rows: IntArray, options: DriftOptions
    ) -> None:
        stamps, self._options = np.unique(stamp_ns), options
        at, keys = interpolated(trajectory, stamps), trajectory.stamp_ns[rows]
        after = np.clip(np.searchsorted(keys, stamps), 1, len(keys) - 1)
        nearest = after - (stamps - keys[after - 1] < keys[after] - stamps)
        self._nearest = {
            int(stamp): (int(k), _between(at, i, trajectory, int(rows[k])))
            for i, (stamp, k) in enumerate(zip(stamps, nearest, strict=True))
        }

    def fix(self, fix: PoseFix) -> _Link:
        """Return a key pose in the map."""
        k, T_scan_key = self._nearest[fix.stamp_ns]
        covariance = moved(fix.covariance[None], T_scan_key)[0] + self._drift(T_scan_key)
        return _Link(MAP, k, compose(fix.T_map_lidar, T_scan_key), covariance)

    def loop(self, loop: LoopClosure) -> _Link:
        """Return a key pose in the frame of an earlier one."""
        origin, T_first_origin = self._nearest[loop.from_ns]
        k, T_second_key = self._nearest[loop.to_ns]
        T_origin_first = T_first_origin.inverse()
        T_first_key = compose(loop.T_from_to, T_second_key)
        covariance = moved(loop.covariance[None], T_second_key)[0] + self._drift(T_second_key)
        covariance += moved(self._drift(T_origin_first)[None], T_first_key)[0]
        return _Link(origin, k, compose(T_origin_first, T_first_key), covariance)

    def _drift(self, T: RigidTransform) -> FloatArray:
        return np.asarray(drift_covariance(T.R[None], T.t[None], self._options)[0])


def _between(one: Trajectory, i: int, other: Trajectory, k: int) -> RigidTransform:
    """Return a pose of the other trajectory in the frame of a pose of the first."""
    first, second = (RigidTransform(each.R[n], each.p[n]) for each, n in ((one, i), (other, k)))
    return between(first, second)


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

    def loosened(self, distortion: float, offset: float) -> "KnownSensors":
        """Return them with less certain C, and H in uT: by these standard deviations more."""
        more = np.concatenate([np.zeros(3), np.full(9, distortion**2), np.full(3, offset**2)])
        return replace(self, covariance=self.covariance + np.diag(more))

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
            In its standard deviations, along the axes of the poses, shape (6,); None for none.
        poses
            K key poses.
        """
        if drift is None or self.steps.steady is None:
            return self
        added = self.steps.steady @ drift.reshape(2, 3)
        R = np.stack([pose.rotation().matrix() for pose in poses[:-1]])
        own, fixed = np.einsum("nji,nj->ni", R, added), self.steps.fixed_axes
        if fixed is not None:
            fixed = fixed - added @ self.start.T_map_lidar.R
        steps = replace(self.steps, p=self.steps.p - own, fixed_axes=fixed, steady=None)
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


def thinned_readings(
    readings: Readings, trajectory: Trajectory, rows: IntArray, most: int
) -> Readings:
    """Return readings in order of key poses and sensors, at most so many of each on each.

    Parameters
    ----------
    readings
        N readings with poses of odometry.
    trajectory
        Odometry, M poses.
    rows
        Rows of the key poses in it, shape (K,).
    most
        Limit of readings per sensor and key pose, spread over its time.
    """
    key = _key_poses(readings, trajectory, rows)
    return readings[evenly_spread(np.column_stack([key, readings.sensor]), most)]


def key_pose_readings(
    readings: Readings, trajectory: Trajectory, rows: IntArray
) -> KeyPoseReadings:
    """Express readings relative to the key pose before each.

    A reading at the time of a key pose belongs to the one before it, as the end of that step.

    Parameters
    ----------
    readings, trajectory, rows
        As of ``thinned_readings``.
    """
    key = _key_poses(readings, trajectory, rows)
    R_back, p = trajectory.R[rows[key]].transpose(0, 2, 1), trajectory.p[rows[key]]
    return KeyPoseReadings(
        key_pose=key,
        sensor=readings.sensor,
        R_key_lidar=R_back @ readings.R_map_lidar,
        p_key_lidar=np.einsum("nij,nj->ni", R_back, readings.p_map_lidar - p),
        fraction=_fractions(trajectory, rows[key], rows[key + 1], readings.stamp_ns),
        field=readings.field,
    )


def _key_poses(readings: Readings, trajectory: Trajectory, rows: IntArray) -> IntArray:
    """Return the number of the key pose before each reading, shape (N,)."""
    key = np.searchsorted(trajectory.stamp_ns[rows], readings.stamp_ns) - 1
    return np.asarray(np.clip(key, 0, len(rows) - 2))


def _fractions(
    trajectory: Trajectory, first: IntArray, last: IntArray, stamp_ns: IntArray
) -> FloatArray:
    """Return the fraction of the motion from a first pose to a last that is done, shape (N,)."""
    turn = Rotation.from_matrix(trajectory.R[:-1].transpose(0, 2, 1) @ trajectory.R[1:]).magnitude()
    seconds = 1e-9 * (trajectory.stamp_ns - trajectory.stamp_ns[0])
    distance = np.linalg.norm(np.diff(trajectory.p, axis=0), axis=1)
    done = np.append(0.0, np.cumsum(distance + ARM_M * turn + CREEP_M_S * np.diff(seconds)))
    at = np.interp(1e-9 * (stamp_ns - trajectory.stamp_ns[0]), seconds, done)
    return np.asarray(np.clip((at - done[first]) / (done[last] - done[first]), 0.0, 1.0))


def evenly_spread(groups: IntArray, most: int) -> IntArray:
    """Return at most so many rows of each group, spread over it, ordered by group.

    ``groups`` has a row of labels for each, shape (N, L); members of a group come in order.
    """
    order = np.lexsort(groups.T[::-1])
    ends = np.flatnonzero(np.diff(groups[order], axis=0).any(axis=1)) + 1
    return np.concatenate([_evenly(part, most) for part in np.split(order, ends)])


def _evenly(rows: IntArray, most: int) -> IntArray:
    chosen = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    return np.asarray(rows[chosen])
