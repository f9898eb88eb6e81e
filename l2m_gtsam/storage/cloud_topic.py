"""A cloud of the surroundings out of a bag: its scans, placed by the poses of the lidar."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Count
from l2m_gtsam.records.scans import Scan, ScanOptions, taken_at_once
from l2m_gtsam.storage.bag_options import Stamps
from l2m_gtsam.storage.cloud import VoxelMeans, located
from l2m_gtsam.storage.open_bag import open_bag
from l2m_gtsam.storage.point_cloud2 import cloud_connections, points_of, times_of
from l2m_gtsam.storage.point_table import MAX_POINTS
from l2m_gtsam.storage.tf import Link


class CloudTopicOptions(ScanOptions):
    """How the scans of a topic become one cloud."""

    edge: float = Field(default=0.1, ge=0.01)
    """Scans are merged in cells of this size in metres, one point each."""
    max_range: float = Field(default=20.0, gt=0, le=1000)
    """Further points are dropped, metres from the lidar: they are out of reach of the sensors,
    and the errors of the poses' rotations grow with the distance."""
    max_pose_gap_s: float = Field(default=0.5, gt=0)
    """Scans between two poses further apart than this are skipped."""


@dataclass(frozen=True)
class TopicCloud:
    """The cloud of a topic, and what it is made of.

    Attributes
    ----------
    points
        One point per cell, in the map frame in metres, shape (N, 3).
    scans
        Scans received.
    without_pose
        Those of them that were skipped: before the first pose, after the last or in a gap.
    """

    points: FloatArray
    scans: int
    without_pose: int


def read_cloud_topic(
    path: Path,
    topic: str,
    trajectory: Trajectory,
    options: CloudTopicOptions,
    stamps: Stamps = Stamps.HEADER,
    progress: Count | None = None,
) -> TopicCloud:
    """Return what all scans of a topic saw, in the map frame.

    Scans must be in the frame of the lidar, whose poses the trajectory holds; what their frame is
    called does not matter, but it must be the same in all of them. Points with times of their own
    are moved to where they were at the scan's stamp; a scan without is taken as a snapshot: where
    its driver does not correct for motion, points are off by up to speed times the duration of a
    scan. Poses are interpolated on SE(3) as in `sync`.

    Parameters
    ----------
    path
        Bag of any kind.
    topic
        Topic of type sensor_msgs/PointCloud2; the leading slash does not matter.
    trajectory
        Poses of the lidar in the map, by the same clock.
    options
        How scans are merged.
    stamps
        Which time of a scan counts, as for the poses.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        The bag, the topic or a scan is not usable, or no scan has a pose or a point.
    MapError
        The poses are too far from the origin of the map.
    """
    where = f"{path}: topic {topic}"
    merged = _MergedScans(where, trajectory, options)
    try:
        with open_bag(path) as bag:
            for message in bag.messages(cloud_connections(bag, topic), progress):
                merged.add(message.content, message.stamp_ns(stamps))
        return merged.cloud()
    except ValueError as error:
        raise BagError(f"{where}: {error}") from error


class _MergedScans:
    """The cells of all scans so far."""

    def __init__(self, where: str, trajectory: Trajectory, options: CloudTopicOptions) -> None:
        self._where = where
        self._trajectory = trajectory
        self._options = options
        self._frame: str | None = None
        self._cells = VoxelMeans(options.edge)
        self._scans = self._placed = 0

    def add(self, scan: Any, stamp_ns: int) -> None:
        """Place and merge one scan; a ValueError if it is not usable."""
        self._check_frame(scan.header.frame_id)
        self._scans += 1
        pose = self._pose_at(stamp_ns)
        points = None if pose is None else self._points(scan, stamp_ns, pose)
        if pose is None or points is None:
            return
        self._placed += 1
        self._cells.add(located(points @ pose.R.T + pose.t, self._where))
        if len(self._cells) > MAX_POINTS:
            raise BagError(
                f"{self._where}: fills more than {MAX_POINTS} cells of {self._options.edge:g} m; "
                "take larger ones or a smaller `max_range`"
            )

    def cloud(self) -> TopicCloud:
        """Return the cloud of the scans so far; a ValueError if it cannot be."""
        if not self._placed:
            raise BagError(self._nothing_placed())
        points = self._cells.points()
        if not len(points):
            raise BagError(
                f"{self._where}: no scan has a finite point between {self._options.min_range:g} "
                f"and {self._options.max_range:g} m from the lidar; are its points in metres?"
            )
        return TopicCloud(points, self._scans, self._scans - self._placed)

    def _points(self, message: Any, stamp_ns: int, pose: RigidTransform) -> FloatArray | None:
        """Return a scan's points as they were at its stamp; nothing where its end has no pose."""
        scan = Scan(stamp_ns, points_of(message), times_of(message, stamp_ns))
        twist = self._twist(scan, pose)
        return None if twist is None else _in_range(taken_at_once(scan, twist), self._options)

    def _pose_at(self, stamp_ns: int) -> RigidTransform | None:
        """Return the pose at a time, or nothing where there is none on either side near enough."""
        trajectory, known = self._trajectory, self._trajectory.stamp_ns
        most_ns = self._options.max_pose_gap_s * 1e9
        after = int(np.searchsorted(known, stamp_ns))
        if after < len(known) and known[after] == stamp_ns:
            return RigidTransform(trajectory.R[after], trajectory.p[after])
        if after in (0, len(known)) or known[after] - known[after - 1] > most_ns:
            return None
        near = trajectory[np.array([after - 1, after])]
        ends = Link(near.frame, near.child_frame, near.stamp_ns, near.R, near.p)
        between = ends.at(np.array([stamp_ns]))
        return RigidTransform(between.R[0], between.p[0])

    def _twist(self, scan: Scan, pose: RigidTransform) -> FloatArray | None:
        """Return the lidar's mean twist over a scan; nothing where its end has no pose."""
        time_s = np.zeros(1) if scan.time_s is None else scan.time_s
        furthest = float(time_s[np.nanargmax(np.abs(time_s))])
        if furthest == 0.0:
            return np.zeros(6)
        end = self._pose_at(scan.stamp_ns + round(furthest * 1e9))
        if end is None:
            return None
        turn = Rotation.from_matrix(pose.R.T @ end.R).as_rotvec()
        return np.concatenate([turn, pose.R.T @ (end.t - pose.t)]) / furthest

    def _check_frame(self, frame: str) -> None:
        self._frame = frame if self._frame is None else self._frame
        if frame != self._frame:
            raise BagError(
                f"{self._where}: has scans in several frames ({self._frame}, {frame}); record "
                "one topic per lidar"
            )
        if frame.lstrip("/") == self._trajectory.frame.lstrip("/") != "":
            raise BagError(
                f"{self._where}: its scans are in {frame!r}, the frame of the map, where poses "
                "must not move them; give the lidar's own scans, or save the cloud to a file"
            )

    def _nothing_placed(self) -> str:
        if not self._scans or not len(self._trajectory):
            return f"{self._where}: there are no scans, or no poses to place them by"
        first, last = self._trajectory.stamp_ns[[0, -1]] * 1e-9
        return (
            f"{self._where}: none of its {self._scans} scans has a pose: poses run from "
            f"{first:.3f} to {last:.3f} s and may be {self._options.max_pose_gap_s:g} s apart at "
            "most; if the clocks differ, try `bag.stamps: record`"
        )


def _in_range(points: FloatArray, options: CloudTopicOptions) -> FloatArray:
    """Return the points, shape (N, 3), at a useful distance; NaN is at none."""
    points = points[np.all(np.abs(points) <= options.max_range, axis=1)]
    distance = np.linalg.norm(points, axis=1)
    return np.asarray(points[(distance >= options.min_range) & (distance <= options.max_range)])
