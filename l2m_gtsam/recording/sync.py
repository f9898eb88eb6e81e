"""Interpolate poses at readings, and thin readings at the same place."""

from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import (
    BoolArray,
    FieldSeries,
    FloatArray,
    IntArray,
    LidarMotion,
    Readings,
    Recording,
    SyncCounts,
    Synchronised,
    Trajectory,
    joined_rows,
)
from l2m_gtsam.errors import SyncError
from l2m_gtsam.geometry import interpolated_rotations, turn_angle
from l2m_gtsam.options import Options
from l2m_gtsam.recording.saturation import is_saturated, saturated_axes


class SyncOptions(Options):
    """How readings get their poses and which of them are kept."""

    max_pose_gap_s: float = Field(default=0.5, gt=0)
    """Readings between two poses further apart than this are dropped, as are those between two
    that differ by a turn of more than 45 degrees; poses are never extrapolated."""
    thin_distance_m: float = Field(default=0.02, ge=0)
    """Of readings whose poses fall into one cell of this size (and of `thin_angle_deg`) the first
    is kept: a parked vehicle adds no information about the map. 0 does not look at the place."""
    thin_angle_deg: float = Field(default=2.0, ge=0)
    """Size of a cell in rotation; 0 does not look at it. With both 0 every reading is kept."""


# Readings that vary less than this are stuck: a moving magnetometer's noise alone is larger.
STUCK_UT = 1e-3
# Between two poses the body is taken to turn steadily: if it begins or ends at rest, that is wrong
# by up to a quarter of the turn.
MOST_TURN_DEG = 45.0
# Velocities are taken over this time: between two poses their noise would be a large part.
TWIST_S = 0.1
# And accelerations over this: to either side a period of poses at 10 Hz, between which they are
# interpolated.
ACCELERATION_S = 0.2


def synchronise(
    recording: Recording, options: SyncOptions, largest_offset_s: float = 0.0
) -> Synchronised:
    """Interpolate the lidar's pose at every reading.

    Parameters
    ----------
    recording
        Poses and readings.
    options
        Which readings are kept.
    largest_offset_s
        Readings need poses so much earlier and later, too, because their clock may be off.

    Raises
    ------
    SyncError
        No reading of any sensor lies within the time of the trajectory.

    Notes
    -----
    Readings beyond the range of their sensor do not count: an axis of them is not what it says.
    """
    parts, counts, far = [], [], far_turns(recording.trajectory)
    for index, series in enumerate(recording.series):
        readings, count = _synchronise_one(
            recording.trajectory, far, index, series, options, round(largest_offset_s * 1e9)
        )
        parts.append(readings)
        counts.append(count)
    if not any(count.kept or count.saturated for count in counts):
        raise SyncError(_nothing_left(recording, options, largest_offset_s))
    names = tuple(series.sensor for series in recording.series)
    return Synchronised(replace(joined_rows(parts), sensors=names), tuple(counts))


def _synchronise_one(
    trajectory: Trajectory,
    far: BoolArray,
    index: int,
    series: FieldSeries,
    options: SyncOptions,
    around_ns: int,
) -> tuple[Readings, SyncCounts]:
    finite = np.asarray(np.isfinite(series.field).all(axis=1))
    repeated = _repeated(series.stamp_ns, finite)
    spanned = _spanned(trajectory.stamp_ns, series.stamp_ns, around_ns)
    gap = longest_gap_ns(trajectory.stamp_ns, series.stamp_ns, around_ns)
    turned = is_in_turn(trajectory.stamp_ns, far, series.stamp_ns, around_ns)
    near = (gap <= options.max_pose_gap_s * 1e9) & ~turned
    fresh = finite & ~repeated
    keep = fresh & spanned & near
    readings = _with_poses(trajectory, index, series.stamp_ns[keep], series.field[keep])
    new = _first_in_cell(readings, options)
    limits = saturated_axes(readings.field[new])
    beyond = is_saturated(readings.field, limits)
    if limits:
        readings = readings.select(~beyond)
        new = _first_in_cell(readings, options)
    counts = SyncCounts(
        received=len(series),
        not_finite=int(np.sum(~finite)),
        repeated=int(np.sum(repeated)),
        outside_trajectory=int(np.sum(fresh & ~spanned)),
        in_pose_gap=int(np.sum(fresh & spanned & ~near)),
        thinned=int(np.sum(~new)),
        kept=int(np.sum(new)),
        saturated=int(np.sum(beyond)),
        limits=limits,
    )
    return readings.select(new), counts


def _repeated(stamp_ns: IntArray, finite: BoolArray) -> BoolArray:
    """Mark finite readings whose stamp a finite reading before them already has."""
    repeated = np.ones(len(stamp_ns), dtype=np.bool_)
    rows = np.flatnonzero(finite)
    _, first = np.unique(stamp_ns[rows], return_index=True)
    repeated[rows[first]] = False
    return repeated & finite


def stuck_sensors(readings: Readings) -> list[int]:
    """Return the indices of the sensors that report one constant value."""
    fields = [readings.field[readings.rows_of(i)] for i in range(len(readings.sensors))]
    spreads = [np.ptp(field, axis=0).max() if len(field) else np.inf for field in fields]
    return [index for index, spread in enumerate(spreads) if spread < STUCK_UT]


def stuck_readings(readings: Readings) -> BoolArray:
    """Mark the readings of sensors that report one constant value for a whole drive."""
    stuck = np.zeros(len(readings), dtype=np.bool_)
    for drive in np.unique(readings.of_drive):
        own = readings.of_drive == drive
        stuck |= own & np.isin(readings.sensor, stuck_sensors(readings.select(own)))
    return stuck


def _spanned(pose_ns: IntArray, stamp_ns: IntArray, around_ns: int) -> BoolArray:
    if len(pose_ns) < 2:
        return np.zeros(len(stamp_ns), dtype=np.bool_)
    first, last = pose_ns[0] + around_ns, pose_ns[-1] - around_ns
    return np.asarray((stamp_ns >= first) & (stamp_ns <= last))


def longest_gap_ns(pose_ns: IntArray, stamp_ns: IntArray, around_ns: int = 0) -> IntArray:
    """Return the longest time between two poses around each reading, 0 on a pose."""
    if len(pose_ns) < 2:
        return np.zeros(len(stamp_ns), dtype=np.int64)
    return longest_between(np.diff(pose_ns), *_touched(pose_ns, stamp_ns, around_ns))


def _touched(pose_ns: IntArray, stamp_ns: IntArray, around_ns: int) -> tuple[IntArray, IntArray]:
    """Return the numbers of the poses before and after the time around each reading."""
    before = np.searchsorted(pose_ns, stamp_ns - around_ns, side="right") - 1
    after = np.searchsorted(pose_ns, stamp_ns + around_ns, side="left")
    return np.maximum(before, 0), np.minimum(after, len(pose_ns) - 1)


def longest_between(gap: IntArray, first: IntArray, last: IntArray) -> IntArray:
    """Return the largest of ``gap[first:last]`` for each pair, 0 for none, shape (N,)."""
    pairs = np.column_stack([first, np.maximum(first, last)]).ravel()
    # reduceat takes a single entry where a range is empty; a zero at the end gives it a place.
    largest = np.maximum.reduceat(np.append(gap, 0), pairs)[::2]
    return np.where(last > first, largest, 0)


def _with_poses(
    trajectory: Trajectory, index: int, stamp_ns: IntArray, field: FloatArray
) -> Readings:
    """Return the readings of one sensor with the pose at each stamp."""
    sensor = np.full(len(stamp_ns), index, dtype=np.int64)
    none = np.empty((len(stamp_ns), 3, 3)), np.empty((len(stamp_ns), 3))
    bare = Readings((), sensor, stamp_ns, *none, field)
    return with_offsets(bare, trajectory, np.zeros(index + 1))


def with_offsets(readings: Readings, trajectory: Trajectory, offset: FloatArray) -> Readings:
    """Return readings with the poses that they have if their clocks are off.

    Parameters
    ----------
    readings
        Of S sensors.
    trajectory
        The lidar's poses; beyond its ends the lidar stands still.
    offset
        Time offset of each sensor in seconds, shape (S,): poses are those at stamp + offset.
    """
    own = offset[readings.sensor]
    if not len(readings):
        motion = LidarMotion.steady(np.empty((0, 6)))
        return replace(
            readings, R_map_lidar=np.empty((0, 3, 3)), p_map_lidar=np.empty((0, 3)), motion=motion
        )
    at = 1e-9 * (readings.stamp_ns - trajectory.stamp_ns[0]) + own
    R, p, twist = _moving_at(trajectory, at)
    motion = LidarMotion(twist, _accelerations(trajectory, at, R, p), own)
    return replace(readings, R_map_lidar=R, p_map_lidar=p, motion=motion)


def at_poses(readings: Readings, trajectory: Trajectory, offset: FloatArray) -> Readings:
    """Return readings as ``with_offsets``, but without the lidar's motion, a fifth of the work."""
    own = offset[readings.sensor]
    R, p = _poses_at(trajectory, 1e-9 * (readings.stamp_ns - trajectory.stamp_ns[0]) + own)
    return replace(readings, R_map_lidar=R, p_map_lidar=p, motion=None)


def has_pose(trajectory: Trajectory, stamp_ns: IntArray, max_pose_gap_s: float) -> BoolArray:
    """Return which times lie between two poses that are not further apart, shape (N,)."""
    return lies_between(trajectory.stamp_ns, stamp_ns, max_pose_gap_s)


def lies_between(known_ns: IntArray, stamp_ns: IntArray, max_gap_s: float) -> BoolArray:
    """Return which times lie between two known ones that are not further apart, shape (N,)."""
    spanned = _spanned(known_ns, stamp_ns, 0)
    return spanned & (longest_gap_ns(known_ns, stamp_ns) <= max_gap_s * 1e9)


def far_turns(trajectory: Trajectory) -> BoolArray:
    """Return between which of N poses the body turns too far to be interpolated, shape (N - 1,)."""
    R = trajectory.R
    return np.asarray(turn_angle(R[:-1].transpose(0, 2, 1) @ R[1:]) > np.deg2rad(MOST_TURN_DEG))


def is_in_turn(
    pose_ns: IntArray, far: BoolArray, stamp_ns: IntArray, around_ns: int = 0
) -> BoolArray:
    """Return which readings are so near to a far turn of the poses, in time, shape (N,).

    Parameters
    ----------
    pose_ns, far
        Times of poses, and between which of them the body turns too far; see ``far_turns``.
    stamp_ns
        Times of N readings.
    around_ns
        How near.
    """
    if not far.any():
        return np.zeros(len(stamp_ns), dtype=np.bool_)
    touched = _touched(pose_ns, stamp_ns, around_ns)
    return longest_between(far.astype(np.int64), *touched) > 0


def interpolated(trajectory: Trajectory, stamp_ns: IntArray) -> Trajectory:
    """Return the poses at N times; beyond its ends the body stands still. No covariances."""
    R, p = _poses_at(trajectory, 1e-9 * (stamp_ns - trajectory.stamp_ns[0]))
    return replace(trajectory, stamp_ns=stamp_ns, R=R, p=p, covariance=None)


def twists(trajectory: Trajectory, stamp_ns: IntArray) -> FloatArray:
    """Return the body's velocity at N times: rad/s, then m/s, in its own frame, shape (N, 6)."""
    at = 1e-9 * (stamp_ns - trajectory.stamp_ns[0])
    return _moving_at(trajectory, at)[2]


def _poses_at(trajectory: Trajectory, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Interpolate on SE(3): rotations along the shortest arc, positions along the line.

    ``at`` are seconds after the first pose, shape (N,); rotations (N, 3, 3), positions (N, 3).
    """
    seconds = 1e-9 * (trajectory.stamp_ns - trajectory.stamp_ns[0])
    at = np.clip(at, 0.0, seconds[-1])
    R = interpolated_rotations(trajectory.R, seconds, at)
    return R, np.column_stack([np.interp(at, seconds, axis) for axis in trajectory.p.T])


def _moving_at(trajectory: Trajectory, at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return poses as ``_poses_at``, and the lidar's twist in its own frame, shape (N, 6)."""
    end = 1e-9 * float(trajectory.stamp_ns[-1] - trajectory.stamp_ns[0])
    early, late = np.clip([at - TWIST_S / 2, at + TWIST_S / 2], 0.0, end)
    between = np.maximum(late - early, np.finfo(float).tiny)[:, None]
    # All at once: to begin takes as long as to interpolate thousands.
    rotations, positions = _poses_at(trajectory, np.concatenate([at, early, late]))
    R, R_early, R_late = np.split(rotations, 3)
    p, p_early, p_late = np.split(positions, 3)
    turn = Rotation.from_matrix(R_early.transpose(0, 2, 1) @ R_late).as_rotvec()
    shift = np.einsum("nji,nj->ni", R, p_late - p_early)
    return R, p, np.hstack([turn, shift]) / between


def _accelerations(
    trajectory: Trajectory, at: FloatArray, R: FloatArray, p: FloatArray
) -> FloatArray:
    """Return how the lidar's twist grows at poses, (N, 3, 3) and (N, 3), of N times, shape (N, 6).

    Beyond its ends the lidar stands still: accelerations there are none of a drive, and zero.
    """
    half, N = ACCELERATION_S / 2, len(at)
    end = 1e-9 * float(trajectory.stamp_ns[-1] - trajectory.stamp_ns[0])
    around, places = _poses_at(trajectory, np.concatenate([at - half, at + half]))
    turns = Rotation.from_matrix(np.concatenate([R, R]).transpose(0, 2, 1) @ around).as_rotvec()
    way = np.einsum("nji,nj->ni", R, places[:N] + places[N:] - 2 * p)
    growth = np.hstack([turns[:N] + turns[N:], way]) / half**2
    return np.where(((at < half) | (at > end - half))[:, None], 0.0, growth)


def _first_in_cell(readings: Readings, options: SyncOptions) -> BoolArray:
    """Mark the first reading of every cell of position and rotation."""
    sizes = options.thin_distance_m, float(np.deg2rad(options.thin_angle_deg))
    values = readings.p_map_lidar, readings.R_map_lidar[:, :, :2].reshape(-1, 6)
    parts = [value / size for value, size in zip(values, sizes, strict=True) if size > 0]
    if not parts:
        return np.ones(len(readings), dtype=np.bool_)
    # Rounded, not floored: a vehicle at rest at the origin must not sit on the edge of cells.
    cells = np.rint(np.hstack(parts)).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    keep = np.zeros(len(readings), dtype=np.bool_)
    keep[first] = True
    return keep


def _nothing_left(recording: Recording, options: SyncOptions, largest_offset_s: float) -> str:
    trajectory = recording.trajectory
    stamps = [s.stamp_ns for s in recording.series if len(s)]
    if not stamps or not len(trajectory):
        return f"{recording.source.path}: no readings or no poses to synchronise"
    span = f"{min(s[0] for s in stamps) * 1e-9:.3f} to {max(s[-1] for s in stamps) * 1e-9:.3f} s"
    poses = f"{trajectory.stamp_ns[0] * 1e-9:.3f} to {trajectory.stamp_ns[-1] * 1e-9:.3f} s"
    around = f" for {largest_offset_s:g} s around each reading" if largest_offset_s else ""
    remedy = "try `bag.stamps: record`"
    if recording.poses is not None:
        remedy = f"`bag.pose_file.offset_s` is added to the times of {recording.poses.path}"
    return (
        f"{recording.source.path}: no finite reading has a pose: readings run from {span}, poses "
        f"from {poses}, and poses may be {options.max_pose_gap_s:g} s apart at most{around} "
        f"(`max_pose_gap_s`) and turn by {MOST_TURN_DEG:g} degrees at most from one to the next; "
        f"if their clocks differ, {remedy}"
    )
