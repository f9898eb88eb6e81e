"""Scans where a vehicle's odometry has them: one after another, as steps of a drive. Pure."""

from collections.abc import Iterable, Iterator

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import IDENTITY, between
from l2m_gtsam.lidar.odometry import LEAST_POINTS, ScanStep
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.recording.odometry_jumps import Mended
from l2m_gtsam.recording.sync import has_pose, interpolated, twists
from l2m_gtsam.records.scans import Scan, taken_at_once
from l2m_gtsam.slam.odometry import drift_covariance
from l2m_gtsam.slam.options import SlamOptions

NEIGHBOURHOOD_NS = 1_000_000_000  # of odometry about a scan, in which its motion is looked up


def carried_scans(
    scans: Iterable[Scan], mended: Mended, edge: float, options: SlamOptions
) -> Iterator[ScanStep]:
    """Yield the scans that have points enough and a pose, each with that pose.

    Parameters
    ----------
    scans
        In order of time.
    mended
        Poses of the vehicle by odometry, in the same clock, without its jumps.
    edge
        Scans are thinned to a point per cell of this size in metres.
    options
        Which gaps of odometry are bridged, and how far it is trusted.
    """
    last: RigidTransform | None = None
    last_ns = 0
    for scan in scans:
        at = np.array([scan.stamp_ns], dtype=np.int64)
        near = _around(mended.trajectory, scan.stamp_ns)
        if len(scan) < LEAST_POINTS or not has_pose(near, at, options.max_pose_gap_s)[0]:
            continue
        pose = interpolated(near, at)
        here = RigidTransform(pose.R[0], pose.p[0])
        step = IDENTITY if last is None else between(last, here)
        covariance = drift_covariance(step.R[None], step.t[None], options.drift)[0]
        if last is not None:
            covariance += _jumps_between(mended, last_ns, scan.stamp_ns)
        surface = Surface(taken_at_once(scan, twists(near, at)[0]), edge)
        yield ScanStep(scan.stamp_ns, here, step, covariance, surface, believed=True)
        last, last_ns = here, scan.stamp_ns


def _jumps_between(mended: Mended, first_ns: int, last_ns: int) -> FloatArray:
    """Return what jumps in some time add to the covariance of a step over it, shape (6, 6)."""
    stamps = mended.trajectory.stamp_ns
    return sum(
        (
            each.covariance
            for each in mended.jumps
            if stamps[each.row] < last_ns and stamps[each.row + 1] > first_ns
        ),
        start=np.zeros((6, 6)),
    )


def _around(trajectory: Trajectory, stamp_ns: int) -> Trajectory:
    """Return the poses about a time, two at least."""
    ends = np.array([stamp_ns - NEIGHBOURHOOD_NS, stamp_ns + NEIGHBOURHOOD_NS])
    first, last = np.searchsorted(trajectory.stamp_ns, ends)
    first = int(np.clip(first - 1, 0, max(len(trajectory) - 2, 0)))
    rows: IntArray = np.arange(first, min(max(int(last) + 1, first + 2), len(trajectory)))
    return trajectory[rows]
