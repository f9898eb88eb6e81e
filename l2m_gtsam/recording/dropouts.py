"""Times in which a magnetometer repeats one value, is out of its range or silent. Pure."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import (
    BoolArray,
    FieldSeries,
    FloatArray,
    IntArray,
    Recording,
    SaturatedAxis,
    Trajectory,
)
from l2m_gtsam.recording.saturation import is_saturated, saturated_axes, saturation_doubts
from l2m_gtsam.recording.sync import STUCK_UT, interpolated

# So many readings that are identical while the vehicle moves so far, or turns so much.
LEAST_SAME = 10
MOVED_M, TURNED_DEG = 0.3, 10.0
LOOKED_AT = 50  # limit of poses that are compared in such a run
REPORTED_S = 5.0  # gaps between readings are reported if they exceed this
USUAL = 20.0  # and this multiple of the median gap


@dataclass(frozen=True)
class MaskedRecording:
    """A recording with its dropouts masked.

    Attributes
    ----------
    recording
        Its readings, NaN where a sensor repeats one value or its range is exceeded.
    notes
        A sentence for each sensor with dropouts, and for each whose range is exceeded.
    """

    recording: Recording
    notes: tuple[str, ...]


def mask_dropouts(recording: Recording) -> MaskedRecording:
    """Mask readings that a sensor repeats while the vehicle moves, or beyond its range, as NaN."""
    trajectory = recording.trajectory
    alive = [_alive(each, trajectory) for each in recording.series]
    limits = [saturated_axes(_finite(each)) for each in alive]
    series = tuple(map(_within_range, alive, limits))
    notes = [_note(each, trajectory) for each in alive]
    notes += saturation_doubts([each.sensor for each in series], limits)
    return MaskedRecording(replace(recording, series=series), tuple(note for note in notes if note))


def is_dead(series: FieldSeries) -> bool:
    """Return whether a sensor has no reading at all."""
    return not np.isfinite(series.field).all(axis=1).any()


def _finite(series: FieldSeries) -> FloatArray:
    return series.field[np.isfinite(series.field).all(axis=1)]


def _within_range(series: FieldSeries, limits: tuple[SaturatedAxis, ...]) -> FieldSeries:
    """Return the same, NaN where readings are at limits of the range."""
    if not limits:
        return series
    beyond = is_saturated(series.field, limits)
    return replace(series, field=np.where(beyond[:, None], np.nan, series.field))


def _alive(series: FieldSeries, trajectory: Trajectory) -> FieldSeries:
    rows = np.flatnonzero(np.isfinite(series.field).all(axis=1))
    field = series.field[rows]
    if len(rows) and np.ptp(field, axis=0).max() < STUCK_UT:
        return replace(series, field=np.full_like(series.field, np.nan))
    stuck = rows[_repeated(field, series.stamp_ns[rows], trajectory)]
    if not len(stuck):
        return series
    alive = series.field.copy()
    alive[stuck] = np.nan
    return replace(series, field=alive)


def _repeated(field: FloatArray, stamp_ns: IntArray, trajectory: Trajectory) -> BoolArray:
    """Mark readings in runs of one value over which the vehicle moves, shape (N,)."""
    repeated = np.zeros(len(field), dtype=np.bool_)
    changes = np.flatnonzero(np.any(field[1:] != field[:-1], axis=1)) + 1
    edges = np.concatenate([[0], changes, [len(field)]])
    for run in np.flatnonzero(np.diff(edges) >= LEAST_SAME):
        own = slice(edges[run], edges[run + 1])
        repeated[own] = _moves(trajectory, stamp_ns[own])
    return repeated


def _moves(trajectory: Trajectory, stamp_ns: IntArray) -> bool:
    """Return whether the vehicle gets away from where it is at the first of these times."""
    some = np.linspace(0, len(stamp_ns) - 1, min(LOOKED_AT, len(stamp_ns))).astype(np.int64)
    at = interpolated(trajectory, stamp_ns[some])
    away = np.linalg.norm(at.p - at.p[0], axis=1).max()
    trace = np.einsum("ij,nij->n", at.R[0], at.R)
    turned = np.rad2deg(np.arccos(np.clip((trace.min() - 1) / 2, -1.0, 1.0)))
    return bool(away > MOVED_M or turned > TURNED_DEG)


def _note(series: FieldSeries, trajectory: Trajectory) -> str:
    """Return the share of a drive that a sensor is dead, and the longest gap; empty for none."""
    rows = np.isfinite(series.field).all(axis=1)
    first, last = trajectory.stamp_ns[[0, -1]]
    read = series.stamp_ns[rows & (series.stamp_ns >= first) & (series.stamp_ns <= last)]
    if not len(read):
        return ""
    stamps = np.concatenate([[first], read, [last]])
    between = 1e-9 * np.diff(stamps)
    dead = between > max(REPORTED_S, USUAL * float(np.median(between)))
    if not dead.any():
        return ""
    longest = int(np.argmax(between))
    start, end = (1e-9 * float(stamps[longest + k] - first) for k in (0, 1))
    share = between[dead].sum() / between.sum()
    return (
        f"{series.sensor} is dead for {share:.0%} of the drive, longest from {start:.1f} to "
        f"{end:.1f} s after its start: it repeats one value there, or sends nothing"
    )
