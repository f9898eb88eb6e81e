"""Readings of a drive relative to its key poses."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray, IntArray, Readings, Trajectory, joined_rows
from l2m_gtsam.geometry import turn_angle

ARM_M = 1.0  # lever arm that converts a rotation into a distance
CREEP_M_S = 1e-6  # makes the progress of a parked vehicle increase with time

# Makes readings fewer: of readings, odometry, rows of its key poses, and the most of each sensor.
Fewer = Callable[[Readings, Trajectory, IntArray, int], Readings]


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


def mean_readings(
    readings: Readings, trajectory: Trajectory, rows: IntArray, most: int
) -> Readings:
    """Return means of readings in order of key poses and sensors, at most so many of each on each.

    The place of a mean is that of its readings' mean position and rotation, which leaves out a
    twelfth of the square of the way, and of the turn, between the first and the last of them.
    Parameters as of ``thinned_readings``.
    """
    key = _key_poses(readings, trajectory, rows)
    order = np.lexsort((readings.stamp_ns, readings.sensor, key))
    if not len(order):
        return readings
    groups = np.column_stack([key, readings.sensor])[order]
    begins = np.flatnonzero(np.append(True, np.diff(groups, axis=0).any(axis=1)))
    sizes = np.diff(np.append(begins, len(order)))
    group = np.repeat(np.arange(len(begins)), sizes)
    nth = np.arange(len(order)) - begins[group]
    part = nth * np.minimum(most, sizes)[group] // sizes[group]
    starts = np.flatnonzero(np.append(True, (np.diff(group) > 0) | (np.diff(part) > 0)))
    counts = np.diff(np.append(starts, len(order)))
    every, first = readings[order], readings[order[starts]]
    since = every.stamp_ns - np.repeat(first.stamp_ns, counts)

    def mean(values: FloatArray) -> FloatArray:
        total = np.add.reduceat(values, starts, axis=0)
        return np.asarray(total / counts.reshape(-1, *np.ones(total.ndim - 1, dtype=int)))

    return replace(
        first,
        stamp_ns=first.stamp_ns + np.rint(mean(since.astype(np.float64))).astype(np.int64),
        R_map_lidar=Rotation.from_matrix(mean(every.R_map_lidar)).as_matrix(),
        p_map_lidar=mean(every.p_map_lidar),
        field=mean(every.field),
    )


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


def no_readings() -> KeyPoseReadings:
    """Return the readings of a stretch that has none."""
    no = np.empty(0, dtype=np.int64)
    return KeyPoseReadings(
        no, no, np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0), np.empty((0, 3))
    )


def joined_readings(parts: Sequence[KeyPoseReadings]) -> KeyPoseReadings:
    """Return readings of some key poses, whose clocks are no variables, as one."""
    return joined_rows([no_readings(), *parts])


def _key_poses(readings: Readings, trajectory: Trajectory, rows: IntArray) -> IntArray:
    """Return the number of the key pose before each reading, shape (N,)."""
    key = np.searchsorted(trajectory.stamp_ns[rows], readings.stamp_ns) - 1
    return np.asarray(np.clip(key, 0, len(rows) - 2))


def _fractions(
    trajectory: Trajectory, first: IntArray, last: IntArray, stamp_ns: IntArray
) -> FloatArray:
    """Return the fraction of the motion from a first pose to a last that is done, shape (N,)."""
    turn = turn_angle(trajectory.R[:-1].transpose(0, 2, 1) @ trajectory.R[1:])
    seconds = 1e-9 * (trajectory.stamp_ns - trajectory.stamp_ns[0])
    distance = np.linalg.norm(np.diff(trajectory.p, axis=0), axis=1)
    done = np.append(0.0, np.cumsum(distance + ARM_M * turn + CREEP_M_S * np.diff(seconds)))
    at = np.interp(1e-9 * (stamp_ns - trajectory.stamp_ns[0]), seconds, done)
    return np.asarray(np.clip((at - done[first]) / (done[last] - done[first]), 0.0, 1.0))


def evenly_spread(groups: IntArray, most: int) -> IntArray:
    """Return at most so many rows of each group, spread over it, ordered by group.

    ``groups`` has a row of labels for each, shape (N, L); members of a group come in order.
    """
    if not len(groups):
        return np.empty(0, dtype=np.int64)
    order = np.lexsort(groups.T[::-1])
    begins = np.flatnonzero(np.append(True, np.diff(groups[order], axis=0).any(axis=1)))
    sizes = np.diff(np.append(begins, len(groups)))
    counts = np.minimum(sizes, most)
    # Of n members those at 0, (n - 1) / (c - 1), ..., n - 1.
    nth = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    apart = (sizes - 1) / np.maximum(counts - 1, 1)
    chosen = np.rint(nth * np.repeat(apart, counts)).astype(np.int64)
    return np.asarray(order[np.repeat(begins, counts) + chosen])
