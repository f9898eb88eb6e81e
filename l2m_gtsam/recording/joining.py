"""Several drives of one vehicle as one recording.

Each drive keeps its own time; on a second time axis drives follow each other a minute apart. So
intervals of time (poses, their errors, runs of rejected readings) end where a drive ends, and
clocks need not be continuous from one drive to the next.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import combinations, pairwise

import numpy as np

from l2m_gtsam.data import (
    FieldSeries,
    FloatArray,
    IntArray,
    LidarMotion,
    Readings,
    Recording,
    ScalarSeries,
    SourceFile,
    SyncCounts,
    Synchronised,
    Trajectory,
    joined_rows,
)
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.recording.saturation import limits_together

# Between drives. Longer than any pause that is looked for in readings, and than any time offset.
PAUSE_NS = 60_000_000_000
# In the middle of it the lidar goes from where a drive ended to where the next starts.
JUMP_NS = 1_000_000
REPEATED = 10  # values that two drives through one place do not have in common at the same times


def joined(recordings: Sequence[Recording]) -> Recording:
    """Return drives as one recording, in order of time; a single one as it is.

    A drive's own time is kept in ``Recording.drives``. Where the drives of a result come in which
    order does not depend on the order in which they are given.

    Parameters
    ----------
    recordings
        Drives of one vehicle whose poses are in one map frame. Sensors are the same if their names
        are; one may be missing in some drives.

    Raises
    ------
    CalibrationError
        There is no drive, one of them twice, or drives have frames, recorded numbers or sensors
        that do not go together.
    """
    if not recordings:
        raise CalibrationError("no drive is given; give one bag or several")
    if len(recordings) == 1:
        return recordings[0]
    _check(recordings)
    drives = tuple(sorted(recordings, key=_when))
    moved = _moved_ns([each.trajectory for each in drives])
    return Recording(
        trajectory=_trajectory(drives, moved),
        series=tuple(_series(name, drives, moved) for name in _sensors(drives)),
        source=_source(drives),
        scalars=tuple(_scalar(each.name, drives, moved) for each in drives[0].scalars),
        drives=drives,
        moved_ns=moved,
    )


def joined_readings(parts: Sequence[Synchronised], recording: Recording) -> Synchronised:
    """Return the readings of all drives of a recording as one batch; of a single one as they are.

    A drive without motion of its own counts as standing still, one without pose errors as exact.

    Parameters
    ----------
    parts
        Of each drive, in its own time.
    recording
        What they are of.
    """
    if not recording.drives:
        return parts[0]
    names = tuple(each.sensor for each in recording.series)
    readings = [each.readings for each in parts]
    moving = any(each.motion is not None for each in readings)
    uncertain = any(each.pose_root is not None for each in readings)
    whole = joined_rows(
        [
            replace(
                each,
                sensors=names,
                sensor=_numbers(each, names)[each.sensor],
                stamp_ns=each.stamp_ns + by,
                motion=_motion(each) if moving else None,
                pose_root=_pose_root(each) if uncertain else None,
                drive=np.full(len(each), number),
            )
            for number, (each, by) in enumerate(zip(readings, recording.moved_ns, strict=True))
        ]
    )
    counts = tuple(_counts(name, parts) for name in names)
    return Synchronised(whole[np.argsort(whole.sensor, kind="stable")], counts)


def drive_at(recording: Recording, stamp_ns: int) -> int:
    """Return which drive of a recording a time of its readings, in nanoseconds, belongs to."""
    starts = [
        drive.trajectory.stamp_ns[0] + by - PAUSE_NS // 2
        for drive, by in zip(recording.drives, recording.moved_ns, strict=True)
    ]
    return max(int(np.searchsorted(starts, stamp_ns, side="right")) - 1, 0)


def own_ns(recording: Recording, stamp_ns: int) -> int:
    """Return a time of a recording's readings as its drive counts it, nanoseconds."""
    moved = recording.moved_ns
    return stamp_ns - moved[drive_at(recording, stamp_ns)] if moved else stamp_ns


def _check(recordings: Sequence[Recording]) -> None:
    for one, other in combinations(recordings, 2):
        if _same(one, other):
            raise CalibrationError(
                f"{one.source.path} and {other.source.path} are the same drive, or overlap: the "
                "same readings are in both; list each drive once, and cut logs where they overlap"
            )
        if _one_way(one, other):
            raise CalibrationError(
                f"{one.source.path} and {other.source.path} have the same poses and readings of "
                "the same time: they are one drive, not two; put the readings of all sensors into "
                "one log, in a table with columns for each, as front_mag_x, rear_mag_x (a cell "
                "without a reading is empty)"
            )
    first = recordings[0]
    for each in recordings:
        path, poses = each.source.path, each.trajectory
        if not len(poses):
            raise CalibrationError(f"{path}: it has no poses; leave it out")
        for what, mine, theirs in (
            ("its poses are in frame", first.trajectory.frame, poses.frame),
            ("its poses are those of", first.trajectory.child_frame, poses.child_frame),
        ):
            if mine != theirs:
                raise CalibrationError(
                    f"{path}: {what} {theirs!r}, those of {first.source.path} {mine!r}; drives can "
                    "be joined if both are the same (a map frame of another name: `bag.frame`)"
                )
        if {s.name for s in each.scalars} != {s.name for s in first.scalars}:
            raise CalibrationError(
                f"{path}: it has other recorded numbers than {first.source.path}; both need those "
                "of `bag.regressors`"
            )
        others = {s.sensor for r in recordings if r is not each for s in r.series}
        own = [s.sensor for s in each.series]
        if others.isdisjoint(own):
            raise CalibrationError(
                f"{path}: none of its sensors ({', '.join(own)}) is in another drive, which have "
                f"{', '.join(sorted(others))}; calibrate it by itself"
            )


def _one_way(one: Recording, other: Recording) -> bool:
    """Whether two recordings are of one drive, as far as poses and times tell."""
    return (
        np.array_equal(one.trajectory.stamp_ns, other.trajectory.stamp_ns)
        and np.array_equal(one.trajectory.p, other.trajectory.p)
        and any(_overlap(a, b) for a in one.series for b in other.series)
    )


def _overlap(one: FieldSeries, other: FieldSeries) -> bool:
    """Whether series, in order of time, have readings of one time."""
    if not (len(one) and len(other)):
        return False
    last_start = max(one.stamp_ns[0], other.stamp_ns[0])
    return bool(last_start <= min(one.stamp_ns[-1], other.stamp_ns[-1]))


def _same(one: Recording, other: Recording) -> bool:
    """Whether two recordings hold the same readings, all or some, in whatever kind of file."""
    if one.source.sha256 and one.source.sha256 == other.source.sha256:
        return True
    theirs = {each.sensor: each for each in other.series}
    return any(_repeated(each, theirs[each.sensor]) for each in one.series if each.sensor in theirs)


def _repeated(one: FieldSeries, other: FieldSeries) -> bool:
    """Whether series have readings in common: most that are of one time, and several values.

    Clocks of two drives may start alike, and a sensor may be stuck on one value in both.
    """
    _, at, there = np.intersect1d(one.stamp_ns, other.stamp_ns, return_indices=True)
    mine, theirs = one.field[at], other.field[there]
    read = np.isfinite(mine).all(axis=1)  # of some sensors half of all are not
    alike = (mine[read] == theirs[read]).all(axis=1)
    values = np.unique(mine[read][alike], axis=0)
    return bool(2 * alike.sum() > len(alike) and len(values) >= REPEATED)


def _when(recording: Recording) -> tuple[int, str, str]:
    """Return what orders drives: their start; of clocks that start alike anything that is fixed."""
    return (int(recording.trajectory.stamp_ns[0]), recording.source.sha256, recording.source.path)


def _moved_ns(trajectories: Sequence[Trajectory]) -> tuple[int, ...]:
    """Return by how much each drive is moved so that it starts a pause after the last one's end."""
    moved = [0]
    for last, following in pairwise(trajectories):
        end = int(last.stamp_ns[-1]) + moved[-1]
        moved.append(end + PAUSE_NS - int(following.stamp_ns[0]))
    return tuple(moved)


def _trajectory(drives: Sequence[Recording], moved: Sequence[int]) -> Trajectory:
    """Return all poses; in the pauses the lidar stands where a drive ended, then where one starts.

    So a pose beyond a drive's end is that of its end, as it is for a single drive.
    """
    parts = []
    for k, (drive, by) in enumerate(zip(drives, moved, strict=True)):
        own = drive.trajectory.stamp_ns + by
        before = [own[0] - PAUSE_NS // 2 + JUMP_NS] if k > 0 else []
        after = [own[-1] + PAUSE_NS // 2] if k + 1 < len(drives) else []
        stamps = np.concatenate([before, own, after]).astype(np.int64)
        first, last = [0] * len(before), [len(own) - 1] * len(after)
        rows = np.concatenate([first, np.arange(len(own)), last]).astype(np.int64)
        parts.append(replace(drive.trajectory[rows], stamp_ns=stamps))
    return joined_rows(parts)


def _sensors(drives: Sequence[Recording]) -> list[str]:
    return list(dict.fromkeys(each.sensor for drive in drives for each in drive.series))


def _series(name: str, drives: Sequence[Recording], moved: Sequence[int]) -> FieldSeries:
    """Return a sensor's readings of all drives, in order of time."""
    parts = [
        replace(each, stamp_ns=each.stamp_ns + by)
        for drive, by in zip(drives, moved, strict=True)
        for each in drive.series
        if each.sensor == name
    ]
    whole = joined_rows(parts)
    return whole[np.argsort(whole.stamp_ns, kind="stable")]


def _scalar(name: str, drives: Sequence[Recording], moved: Sequence[int]) -> ScalarSeries:
    """Return a recorded number of all drives, in order of time."""
    found = [next(each for each in drive.scalars if each.name == name) for drive in drives]
    parts = zip(found, moved, strict=True)
    whole = joined_rows([replace(each, stamp_ns=each.stamp_ns + by) for each, by in parts])
    return whole[np.unique(whole.stamp_ns, return_index=True)[1]]


def _source(drives: Sequence[Recording]) -> SourceFile:
    """Return all files together, for messages."""
    digests = "\0".join(each.source.sha256 for each in drives)
    paths = ", ".join(each.source.path for each in drives)
    return SourceFile(paths, hashlib.sha256(digests.encode()).hexdigest())


def _numbers(readings: Readings, names: Sequence[str]) -> IntArray:
    return np.array([names.index(name) for name in readings.sensors], dtype=np.int64)


def _motion(readings: Readings) -> LidarMotion:
    at_rest = LidarMotion.steady(np.zeros((len(readings), 6)))
    return at_rest if readings.motion is None else readings.motion


def _pose_root(readings: Readings) -> FloatArray:
    exact = np.zeros((len(readings), 6, 6))
    return exact if readings.pose_root is None else readings.pose_root


def _counts(name: str, parts: Sequence[Synchronised]) -> SyncCounts:
    """Return the account of a sensor's readings in all drives."""
    own = [
        each.counts[each.readings.sensors.index(name)]
        for each in parts
        if name in each.readings.sensors
    ]
    limits = limits_together([each.limits for each in own], [_looked_at(each) for each in own])
    numbers = [field.name for field in fields(SyncCounts) if field.name != "limits"]
    sums = {name: sum(getattr(each, name) for each in own) for name in numbers}
    return SyncCounts(**sums, limits=limits)


def _looked_at(counts: SyncCounts) -> int:
    """Return how many readings of a drive were looked at for limits of the range."""
    return counts.limits[0].of if counts.limits else counts.kept + counts.without_regressor
