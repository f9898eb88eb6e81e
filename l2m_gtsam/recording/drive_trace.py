"""Whether two drives are one: the same places at the same times.

The hash of a file says nothing once a drive was copied, cut, reindexed or converted.
"""

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.records.drive_trace import DriveTrace

# Of a trace: about a kilobyte, and still several in a tenth of a drive that was cut out.
POSES = 40
# Poses that were written with millimetres, or are between those that were kept, are as far apart.
NEAR_M = 0.002
# In the part that both have: a vehicle that stands is at one place on many drives.
FEWEST, MOVED_M = 3, 0.1


def trace_of(trajectory: Trajectory) -> DriveTrace:
    """Return what a drive is recognised by.

    Parameters
    ----------
    trajectory
        The lidar's poses, at least one.
    """
    rows = np.unique(np.linspace(0, len(trajectory) - 1, POSES).round().astype(np.int64))
    places = tuple((x, y, z) for x, y, z in trajectory.p[rows].tolist())
    return DriveTrace(tuple(trajectory.stamp_ns[rows].tolist()), places)


def same_drive(one: DriveTrace, other: DriveTrace) -> bool:
    """Return whether two traces were taken of one drive, none of them cut."""
    return is_of(one, np.array(other.stamp_ns, dtype=np.int64), np.reshape(other.p, (-1, 3)))


def is_of(trace: DriveTrace, stamp_ns: IntArray, p: FloatArray) -> bool:
    """Return whether a drive is the one, or a part of the one, that a trace was taken of.

    Parameters
    ----------
    trace
        Of a drive.
    stamp_ns, p
        Poses of the lidar on the same or another drive, in the same map frame: times in
        nanoseconds, shape (N,), and positions in metres, shape (N, 3).
    """
    if not len(stamp_ns):
        return False
    start, end = int(stamp_ns[0]), int(stamp_ns[-1])
    shared = [k for k, stamp in enumerate(trace.stamp_ns) if start <= stamp <= end]
    if len(shared) < FEWEST:
        return False
    # From the start on: nanoseconds since 1970 have more digits than a float.
    seconds = 1e-9 * (stamp_ns - start)
    at = [1e-9 * (trace.stamp_ns[k] - start) for k in shared]
    there = np.array([trace.p[k] for k in shared], dtype=np.float64)
    here = np.stack([np.interp(at, seconds, axis) for axis in p.T], axis=1)
    moved = float(np.linalg.norm(np.ptp(there, axis=0)))
    near = np.linalg.norm(here - there, axis=1) < NEAR_M
    return moved > MOVED_M and bool(near.all())
