"""Single readings that no steel explains: electric pulses, bits that were lost. Pure."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import BoolArray, FieldSeries, FloatArray, IntArray, Readings, Recording
from l2m_gtsam.recording.sync import at_poses, has_pose
from l2m_gtsam.solve.robust import MEDIAN

NOISE_SIGMAS = 5.0  # of the length of three axes; noise alone is longer once in 20,000 readings
AROUND = 3  # readings before one, and after, that it is compared with where no map is known
NEAREST_M = 0.2  # steel is no nearer to the sensors of a survey
LEVER_M = 0.5  # of them on the lidar at most, as far as turns move them
LEAST_NOISE_UT = 0.1  # readings of coarse digits at rest repeat: their scatter says nothing


def spikes(
    sensor: IntArray, moved: FloatArray, lacking: FloatArray, noise: FloatArray, nearest: float
) -> BoolArray:
    """Return which readings no steel explains: those before and after lack too little, shape (N,).

    A dipole's field is m / r^3 to 2 m / r^3 long. Where its sensor has moved by d the distance is
    r + d at most, so that at least half of (r / (r + d))^3 of it is left, and r is no less than
    ``nearest``.

    Parameters
    ----------
    sensor
        Of N readings, those of each sensor together and in order of time, shape (N,).
    moved
        How far the sensor moved from each to the next at most, metres, shape (N - 1,).
    lacking
        What they have that a field without the steel has not, uT, shape (N, 3).
    noise
        Of each reading in uT, shape (N,).
    nearest
        In metres.
    """
    size, same = np.linalg.norm(lacking, axis=1), np.diff(sensor) == 0
    left = 0.5 * (nearest / (nearest + moved)) ** 3
    most = size + NOISE_SIGMAS * noise
    beside = np.zeros((2, len(sensor)), dtype=np.bool_)
    beside[0, 1:] = same & (most[:-1] < left * size[1:])
    beside[1, :-1] = same & (most[1:] < left * size[:-1])
    # The first and the last reading of a sensor have one neighbour.
    ends = ~np.stack([np.append(False, same), np.append(same, False)])
    return np.asarray((beside | ends).all(axis=0) & beside.any(axis=0))


def without_spikes(recording: Recording, max_pose_gap_s: float) -> tuple[Recording, list[float]]:
    """Return a recording without spikes, and which share of each sensor's readings they are.

    Every reading is compared with the median of those around it, before any are thinned out.

    Parameters
    ----------
    recording
        With poses.
    max_pose_gap_s
        Readings between two poses further apart than this stay as they are.
    """
    series, shares = [], []
    for each in recording.series:
        wrong = series_spikes(recording, each, max_pose_gap_s)
        shares.append(float(np.count_nonzero(wrong)) / max(len(each), 1))
        if wrong.any():
            each = each[~wrong]
        series.append(each)
    return replace(recording, series=tuple(series)) if any(shares) else recording, shares


def series_spikes(recording: Recording, series: FieldSeries, max_pose_gap_s: float) -> BoolArray:
    """Return which readings of a sensor are spikes, shape (N,); see ``without_spikes``."""
    wrong = np.zeros(len(series), dtype=np.bool_)
    known = np.isfinite(series.field).all(axis=1)
    known &= has_pose(recording.trajectory, series.stamp_ns, max_pose_gap_s)
    rows = np.flatnonzero(known)
    if len(rows) <= 2 * AROUND:
        return wrong
    nothing = np.empty((len(rows), 3, 3)), np.empty((len(rows), 3))
    sensor = np.zeros(len(rows), dtype=np.int64)
    bare = Readings((), sensor, series.stamp_ns[rows], *nothing, series.field[rows])
    posed = at_poses(bare, recording.trajectory, np.zeros(1))
    # Turned into the map a field changes by its gradient alone, as far as C is a rotation.
    lacking = beside_median(np.einsum("nij,nj->ni", posed.R_map_lidar, posed.field))
    noise = np.sqrt(np.median(np.sum(lacking**2, axis=1)) / MEDIAN)
    own = np.full(len(rows), max(float(noise), LEAST_NOISE_UT))
    found = spikes(sensor, moved_at_most(posed), lacking, own, NEAREST_M)
    # Every other one: of two spikes in a row each has a sound reading before and after.
    for half in (np.arange(0, len(rows), 2), np.arange(1, len(rows), 2)):
        moved = moved_at_most(posed[half])
        found[half[1:-1]] |= spikes(sensor[half], moved, lacking[half], own[half], NEAREST_M)[1:-1]
    wrong[rows] = found
    return wrong


def beside_median(field: FloatArray) -> FloatArray:
    """Return what fields, (N, 3), differ by from the median of those around them, shape (N, 3)."""
    padded = np.pad(field, ((AROUND, AROUND), (0, 0)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND + 1, axis=0)
    return np.asarray(field - np.median(around, axis=2))


def moved_at_most(readings: Readings) -> FloatArray:
    """Return how far the sensor of N readings moved from each to the next, metres, (N - 1,)."""
    shift = np.linalg.norm(np.diff(readings.p_map_lidar, axis=0), axis=1)
    R = readings.R_map_lidar
    cosine = (np.einsum("nij,nij->n", R[1:], R[:-1]) - 1) / 2
    return np.asarray(shift + LEVER_M * np.arccos(np.clip(cosine, -1.0, 1.0)))
