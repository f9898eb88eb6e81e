"""Scan registrations of a drive as links of its key poses."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import (
    BoolArray,
    FloatArray,
    IntArray,
    RigidTransform,
    RowTable,
    Trajectory,
    joined_rows,
)
from l2m_gtsam.geometry import between, compose, moved
from l2m_gtsam.lidar.registration import PoseEstimate
from l2m_gtsam.recording.sync import interpolated
from l2m_gtsam.records.scans import LoopClosure, PoseFix, ScanEvidence
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.options import DriftOptions

MAP = -1  # in place of a key pose: the frame of the map


@dataclass(frozen=True)
class Links(RowTable):
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

    @classmethod
    def none(cls) -> "Links":
        """Return the links of a drive without scans."""
        no = np.empty(0, dtype=np.int64)
        return cls(no, no, np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 6, 6)))

    @classmethod
    def single(cls, origin: int, key_pose: int, found: PoseEstimate) -> "Links":
        """Return one link: a key pose in the frame of an earlier one, or of the map."""
        at, T = (np.array([origin]), np.array([key_pose])), found.T
        return cls(*at, T.R[None], T.t[None], found.covariance[None])

    def estimate(self, row: int) -> PoseEstimate:
        """Return the measured pose of a link."""
        return PoseEstimate(RigidTransform(self.R[row], self.p[row]), self.covariance[row])

    @property
    def in_map(self) -> BoolArray:
        """Which fix a key pose in the map, shape (L,); the others are loop closures."""
        return np.asarray(self.origin == MAP)


def carried_on(found: PoseEstimate, step: RigidTransform, drift: DriftOptions) -> PoseEstimate:
    """Return a measured pose carried on by a step of odometry.

    Parameters
    ----------
    found
        The pose.
    step
        From there, by odometry.
    drift
        Of odometry.
    """
    covariance = moved(found.covariance[None], step)[0] + _drift_of(step, drift)
    return PoseEstimate(compose(found.T, step), covariance)


def seen_from_before(
    found: PoseEstimate, step: RigidTransform, drift: DriftOptions
) -> PoseEstimate:
    """Return a measured pose in a frame from which a step of odometry leads to its own.

    Parameters
    ----------
    found
        The pose, in the frame after the step.
    step, drift
        As of ``carried_on``.
    """
    covariance = found.covariance + moved(_drift_of(step, drift)[None], found.T)[0]
    return PoseEstimate(compose(step, found.T), covariance)


def _drift_of(step: RigidTransform, drift: DriftOptions) -> FloatArray:
    return np.asarray(drift_covariance(step.R[None], step.t[None], drift)[0])


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
    links = joined_rows([*fixes, *(carrier.loop(each) for each in evidence.loops)])
    return links[links.origin != links.key_pose]


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
            int(stamp): (int(k), between(at.pose(i), trajectory.pose(int(rows[k]))))
            for i, (stamp, k) in enumerate(zip(stamps, nearest, strict=True))
        }

    def fix(self, fix: PoseFix) -> Links:
        """Return a key pose in the map."""
        k, T_scan_key = self._nearest[fix.stamp_ns]
        found = PoseEstimate(fix.T_map_lidar, fix.covariance)
        return Links.single(MAP, k, carried_on(found, T_scan_key, self._options))

    def loop(self, loop: LoopClosure) -> Links:
        """Return a key pose in the frame of an earlier one."""
        origin, T_first_origin = self._nearest[loop.from_ns]
        k, T_second_key = self._nearest[loop.to_ns]
        found = PoseEstimate(loop.T_from_to, loop.covariance)
        of_key_pose = carried_on(found, T_second_key, self._options)
        there = seen_from_before(of_key_pose, T_first_origin.inverse(), self._options)
        return Links.single(origin, k, there)
