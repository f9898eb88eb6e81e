"""Bring readings and poses together in time, and keep what says something new."""

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import (
    BoolArray,
    FieldSeries,
    FloatArray,
    IntArray,
    Readings,
    Recording,
    SyncCounts,
    Synchronised,
    Trajectory,
)
from l2m_gtsam.errors import SyncError
from l2m_gtsam.options import Options


class SyncOptions(Options):
    """How readings get their poses and which of them are kept."""

    max_pose_gap_s: float = Field(default=0.5, gt=0)
    """Readings between two poses further apart than this are dropped; poses are never
    extrapolated."""
    thin_distance_m: float = Field(default=0.02, ge=0)
    """Of readings whose poses fall into one cell of this size (and of `thin_angle_deg`) the first
    is kept: a parked vehicle adds no information about the map. 0 does not look at the place."""
    thin_angle_deg: float = Field(default=2.0, ge=0)
    """Size of a cell in rotation; 0 does not look at it. With both 0 every reading is kept."""


# Readings that vary less than this are stuck: a moving magnetometer's noise alone is larger.
STUCK_UT = 1e-3


def synchronise(recording: Recording, options: SyncOptions) -> Synchronised:
    """Interpolate the lidar's pose at every reading.

    Raises
    ------
    SyncError
        No reading of any sensor lies within the time of the trajectory.
    """
    parts, counts = [], []
    for index, series in enumerate(recording.series):
        readings, count = _synchronise_one(recording.trajectory, index, series, options)
        parts.append(readings)
        counts.append(count)
    if not any(count.kept for count in counts):
        raise SyncError(_nothing_left(recording, options))
    return Synchronised(_concatenate(recording, parts), tuple(counts))


def _synchronise_one(
    trajectory: Trajectory, index: int, series: FieldSeries, options: SyncOptions
) -> tuple[Readings, SyncCounts]:
    finite = np.asarray(np.isfinite(series.field).all(axis=1))
    repeated = _repeated(series.stamp_ns, finite)
    spanned = _spanned(trajectory.stamp_ns, series.stamp_ns)
    near = _bracket_ns(trajectory.stamp_ns, series.stamp_ns) <= options.max_pose_gap_s * 1e9
    fresh = finite & ~repeated
    keep = fresh & spanned & near
    readings = _with_poses(trajectory, index, series.stamp_ns[keep], series.field[keep])
    new = _first_in_cell(readings, options)
    counts = SyncCounts(
        received=len(series),
        not_finite=int(np.sum(~finite)),
        repeated=int(np.sum(repeated)),
        outside_trajectory=int(np.sum(fresh & ~spanned)),
        in_pose_gap=int(np.sum(fresh & spanned & ~near)),
        thinned=int(np.sum(~new)),
        kept=int(np.sum(new)),
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


def _spanned(pose_ns: IntArray, stamp_ns: IntArray) -> BoolArray:
    if len(pose_ns) < 2:
        return np.zeros(len(stamp_ns), dtype=np.bool_)
    return np.asarray((stamp_ns >= pose_ns[0]) & (stamp_ns <= pose_ns[-1]))


def _bracket_ns(pose_ns: IntArray, stamp_ns: IntArray) -> IntArray:
    """Return the time between the two poses around each reading, 0 on a pose."""
    if len(pose_ns) < 2:
        return np.zeros(len(stamp_ns), dtype=np.int64)
    after = np.clip(np.searchsorted(pose_ns, stamp_ns), 1, len(pose_ns) - 1)
    gap = pose_ns[after] - pose_ns[after - 1]
    on_pose = (pose_ns[after] == stamp_ns) | (pose_ns[after - 1] == stamp_ns)
    return np.where(on_pose, 0, gap)


def _with_poses(
    trajectory: Trajectory, index: int, stamp_ns: IntArray, field: FloatArray
) -> Readings:
    """Interpolate on SE(3): rotations along the shortest arc, positions along the line."""
    if len(stamp_ns):
        seconds = (trajectory.stamp_ns - trajectory.stamp_ns[0]) * 1e-9
        at = (stamp_ns - trajectory.stamp_ns[0]) * 1e-9
        R = Slerp(seconds, Rotation.from_matrix(trajectory.R))(at).as_matrix()
        p = np.column_stack([np.interp(at, seconds, axis) for axis in trajectory.p.T])
    else:
        R, p = np.empty((0, 3, 3)), np.empty((0, 3))
    return Readings((), np.full(len(stamp_ns), index, dtype=np.int64), stamp_ns, R, p, field)


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


def _concatenate(recording: Recording, parts: list[Readings]) -> Readings:
    return Readings(
        tuple(series.sensor for series in recording.series),
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("sensor", "stamp_ns", "R_map_lidar", "p_map_lidar", "field")
        ),
    )


def _nothing_left(recording: Recording, options: SyncOptions) -> str:
    trajectory = recording.trajectory
    stamps = [s.stamp_ns for s in recording.series if len(s)]
    if not stamps or not len(trajectory):
        return f"{recording.source.path}: no readings or no poses to synchronise"
    span = f"{min(s[0] for s in stamps) * 1e-9:.3f} to {max(s[-1] for s in stamps) * 1e-9:.3f} s"
    poses = f"{trajectory.stamp_ns[0] * 1e-9:.3f} to {trajectory.stamp_ns[-1] * 1e-9:.3f} s"
    return (
        f"{recording.source.path}: no finite reading has a pose: readings run from {span}, poses "
        f"from {poses}, and poses may be {options.max_pose_gap_s:g} s apart at most "
        "(`sync.max_pose_gap_s`); if their clocks differ, try `bag.stamps: record`"
    )
