"""Whether two drives are one: the same places at the same times.

The hash of a file says nothing once a drive was copied, cut, reindexed or converted.
"""

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.records.provenance import DriveTrace

# Of a trace: about a kilobyte, and still several in a tenth of a drive that was cut out.
POSES = 40
# Poses that were written with millimetres are as far apart.
NEAR_M = 0.002
# Between poses that were kept a vehicle leaves the straight line by a dt^2 / 8 at most: those of a
# thinned copy are as far from it. Robots and carts turn and brake with less.
ACCELERATION = 2.0
LONGEST_S = 1.5  # where poses are further apart nothing is compared
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
    start = int(stamp_ns[0])
    # From the start on: nanoseconds since 1970 have more digits than a float.
    seconds = 1e-9 * (stamp_ns - start).astype(np.float64)
    at = 1e-9 * (np.array(trace.stamp_ns, dtype=np.int64) - start).astype(np.float64)
    there = np.reshape(np.array(trace.p, dtype=np.float64), (-1, 3))
    inside = (at >= 0) & (at <= seconds[-1])
    at, there = at[inside], there[inside]
    gaps = _gaps(seconds, at)
    at, there, gaps = at[gaps < LONGEST_S], there[gaps < LONGEST_S], gaps[gaps < LONGEST_S]
    if len(at) < FEWEST:
        return False
    here = np.stack([np.interp(at, seconds, axis) for axis in p.T], axis=1)
    moved = float(np.linalg.norm(np.ptp(there, axis=0)))
    tolerance = NEAR_M + ACCELERATION * gaps**2 / 8
    near = np.linalg.norm(here - there, axis=1) < tolerance
    return moved > MOVED_M + 2 * tolerance.max() and bool(near.all())


def _gaps(seconds: FloatArray, at: FloatArray) -> FloatArray:
    """Return the seconds between the poses on both sides of some times; zero at a pose."""
    after = np.searchsorted(seconds, at)
    before = np.searchsorted(seconds, at, side="right") - 1
    return np.asarray(seconds[np.minimum(after, len(seconds) - 1)] - seconds[before])
