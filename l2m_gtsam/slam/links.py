"""Scan registrations of a drive as links of its key poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import between, compose, moved
from l2m_gtsam.recording.sync import interpolated
from l2m_gtsam.records.scans import LoopClosure, PoseFix, ScanEvidence
from l2m_gtsam.slam.odometry import drift_covariance
from l2m_gtsam.slam.options import DriftOptions

MAP = -1  # in place of a key pose: the frame of the map


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

    @classmethod
    def joined(cls, parts: Sequence["Links"]) -> "Links":
        """Return the links of some parts of a drive as one."""
        return cls(
            np.concatenate([each.origin for each in parts]),
            np.concatenate([each.key_pose for each in parts]),
            np.concatenate([each.R for each in parts]),
            np.concatenate([each.p for each in parts]),
            np.concatenate([each.covariance for each in parts]),
        )

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
