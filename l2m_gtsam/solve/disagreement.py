"""Rejected readings put together: where, and when, sensors and map disagree."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings
from l2m_gtsam.records.calibration import Disagreement, Return

FEWEST = 3  # rejected readings of one sensor in a row: fewer are stray ones
SKIP = 2  # good readings within a run that do not end it
BREAK_S = 1.0  # pause in the readings that ends a run, and between sensors that disagree together
NEAR_M = 0.7  # from a place: there the field is much the same
LATER_S = 5.0  # from one passage to the next


@dataclass(frozen=True)
class Judged:
    """Readings with the verdict of the solve.

    Attributes
    ----------
    readings
        N readings, of each sensor in order of time.
    place
        Of the sensors in the map in metres, shape (N, 3).
    residual
        ``C b + H - z`` in uT, shape (N, 3).
    rejected
        Which do not count, shape (N,).
    """

    readings: Readings
    place: FloatArray
    residual: FloatArray
    rejected: BoolArray


def disagreements(judged: Judged) -> tuple[Disagreement, ...]:
    """Return stretches of the drive over which readings were rejected, in order of time.

    Those of several sensors at about the same time are one.
    """
    runs = [
        run for sensor in range(len(judged.readings.sensors)) for run in runs_of(judged, sensor)
    ]
    return tuple(described(judged, rows) for rows in together(judged, runs))


def runs_of(judged: Judged, sensor: int) -> list[IntArray]:
    """Return the rows of each run of rejected readings of one sensor."""
    own = np.arange(len(judged.rejected))[judged.readings.rows_of(sensor)]
    rows = own[judged.rejected[own]]
    if not len(rows):
        return []
    pause = np.diff(judged.readings.stamp_ns[rows]) > BREAK_S * 1e9
    runs = np.split(rows, np.flatnonzero((np.diff(rows) > SKIP + 1) | pause) + 1)
    return [run for run in runs if len(run) >= FEWEST]


def together(judged: Judged, runs: list[IntArray]) -> list[IntArray]:
    """Return the rows of runs that overlap in time, joined, in order of time."""
    stamps, end = judged.readings.stamp_ns, 0
    joined: list[IntArray] = []
    for run in sorted(runs, key=lambda rows: int(stamps[rows[0]])):
        first, last = int(stamps[run[0]]), int(stamps[run[-1]])
        if joined and first <= end + BREAK_S * 1e9:
            joined[-1], end = np.concatenate([joined[-1], run]), max(end, last)
        else:
            joined.append(run)
            end = last
    return joined


def described(judged: Judged, rows: IntArray) -> Disagreement:
    """Return what is known of a stretch."""
    readings = judged.readings
    stamps = readings.stamp_ns[rows]
    in_time = rows[np.argsort(stamps, kind="stable")]
    lidar = readings.p_map_lidar[in_time]
    return Disagreement(
        sensors=tuple(readings.sensors[s] for s in np.unique(readings.sensor[rows])),
        start_ns=int(stamps.min()),
        end_ns=int(stamps.max()),
        p_from=lidar[0],
        p_to=lidar[-1],
        length=float(np.linalg.norm(np.diff(lidar, axis=0), axis=1).sum()),
        readings=len(rows),
        size=float(np.median(np.linalg.norm(judged.residual[rows], axis=1))),
        passed_again=passed_again(judged, rows),
    )


def passed_again(judged: Judged, rows: IntArray) -> Return:
    """Return what the same sensors read at the same place at another time."""
    readings, stamps = judged.readings, judged.readings.stamp_ns
    low, high = stamps[rows].min() - LATER_S * 1e9, stamps[rows].max() + LATER_S * 1e9
    # Another passage, by the same sensors: a later time, or an earlier one.
    other = np.isin(readings.sensor, readings.sensor[rows]) & ((stamps < low) | (stamps > high))
    other &= np.isfinite(judged.place).all(axis=1)
    if not other.any():
        return Return.NEVER
    away, _ = cKDTree(judged.place[rows]).query(judged.place[other], distance_upper_bound=NEAR_M)
    there = judged.rejected[other][np.isfinite(away)]
    if len(there) < FEWEST:
        return Return.NEVER
    return Return.DIFFERS if there.mean() > 0.5 else Return.AS_MAPPED
