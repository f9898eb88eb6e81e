"""Readings averaged along the drive: one average counts as one reading.

What is not modelled lasts longer than a reading: neighbours are no evidence of their own.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.view import QueryableMap, places_of
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings
from l2m_gtsam.options import Options
from l2m_gtsam.recording.spikes import spikes
from l2m_gtsam.solve.robust import MEDIAN

LEVER_M = 0.3  # that a rotation counts with along the path
FEWEST = 3  # readings of an average whose scatter is their noise
MOST_SLOTS = 3000  # of a drive; longer ones are averaged over longer parts


class AveragingOptions(Options):
    """How readings are averaged before places are judged."""

    step_m: float = Field(default=0.1, gt=0.01, le=1)
    """Path over which readings are averaged, metres: an average counts as one reading, since what
    is not modelled lasts that long."""
    pose_position_m: float = Field(default=0.003, ge=0, le=1)
    """Poses count as wrong by this standard deviation at least, metres."""
    pose_rotation_deg: float = Field(default=0.5, ge=0, le=10)
    """The same of their rotation, degrees."""


@dataclass(frozen=True)
class Averages:
    """Readings that stand for others near them on the path.

    Attributes
    ----------
    readings
        One for each sensor and slot, N of them.
    slot
        Part of the path that each is of, shape (N,).
    residual
        Mean of what the readings lack of the map, map frame, in uT, shape (N, 3).
    counted
        Share of the readings averaged that counted in the solve, shape (N,).
    noise
        Standard deviation of one reading of each sensor within a slot in uT, shape (S,). A solve
        may have put it into errors that are correlated; here it counts as it is.
    """

    readings: Readings
    slot: IntArray
    residual: FloatArray
    counted: FloatArray
    noise: FloatArray


def averaged(
    readings: Readings,
    field_map: QueryableMap,
    estimate: Estimate,
    used: BoolArray,
    options: AveragingOptions,
    nearest: float,
) -> Averages:
    """Return averages of readings inside the map, whether they counted or not, but for spikes.

    Parameters
    ----------
    readings
        All inside the map, M of them, of each sensor in order of time.
    field_map, estimate
        What they are compared with.
    used
        Which of them counted, shape (M,).
    options
        How far to average.
    nearest
        Steel is no nearer to a sensor than this, metres.
    """
    lacking = lacking_field(readings, field_map, estimate)
    moved = np.linalg.norm(np.diff(places_of(readings, estimate.t), axis=0), axis=1)
    noise = readings.noise(estimate.noise)
    kept = ~spikes(readings.sensor, moved, lacking, noise, nearest)
    readings, used, lacking = readings.select(kept), used[kept], lacking[kept]
    slot = slots_of(readings, estimate, options.step_m)
    key = readings.sensor * (int(slot.max(initial=0)) + 1) + slot
    _, own, count = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(own, kind="stable")
    first = np.cumsum(count) - count
    middle = order[first + count // 2]
    mean = np.stack([np.bincount(own, axis) for axis in lacking.T], axis=1) / count[:, None]
    within = scatter(readings, lacking - mean[own], count[own])
    noise = np.maximum(within, estimate.noise)
    return Averages(readings[middle], slot[middle], mean, np.bincount(own, used) / count, noise)


def scatter(readings: Readings, deviation: FloatArray, count: IntArray) -> FloatArray:
    """Return the noise of each of S sensors by what readings differ from their average, uT, (S,).

    Parameters
    ----------
    readings
        M of them.
    deviation
        From the average that each went into, uT, shape (M, 3).
    count
        How many went into it, shape (M,).
    """
    noise = np.zeros(len(readings.sensors))
    squared = np.sum(deviation**2, axis=1) * count / np.maximum(count - 1, 1)
    squared /= readings.noise_ratio**2
    for sensor in np.unique(readings.sensor).tolist():
        own = (readings.sensor == sensor) & (count >= FEWEST)
        if own.any():
            noise[sensor] = np.sqrt(np.median(squared[own]) / MEDIAN)
    return noise


def slots_of(readings: Readings, estimate: Estimate, step: float) -> IntArray:
    """Return which part of the drive each reading is of, alike for all sensors, shape (N,)."""
    late = np.round(1e9 * estimate.offset[readings.sensor]).astype(np.int64)
    order = np.lexsort((readings.stamp_ns + late, readings.of_drive))
    R, p, drive = (
        a[order] for a in (readings.R_map_lidar, readings.p_map_lidar, readings.of_drive)
    )
    moved = np.linalg.norm(np.diff(p, axis=0), axis=1)
    cosine = (np.einsum("nij,nij->n", R[1:], R[:-1]) - 1) / 2
    moved += LEVER_M * np.arccos(np.clip(cosine, -1.0, 1.0))
    path = np.concatenate([[0.0], np.cumsum(np.where(np.diff(drive) == 0, moved, 2 * step))])
    step = max(step, float(path[-1]) / MOST_SLOTS)
    _, number = np.unique(np.floor(path / step).astype(np.int64), return_inverse=True)
    slot = np.empty(len(readings), dtype=np.int64)
    slot[order] = number
    return slot


def lacking_field(readings: Readings, field_map: QueryableMap, estimate: Estimate) -> FloatArray:
    """Return what readings have that the map has not, map frame, in uT, shape (N, 3)."""
    C, H = estimate.C()[readings.sensor], estimate.distortion[readings.sensor, 9:]
    b = np.linalg.solve(C, (readings.field - H)[:, :, None])[:, :, 0]
    field, _ = field_map.field_and_gradient(places_of(readings, estimate.t))
    return np.asarray(np.einsum("nij,nj->ni", readings.R_map_lidar, b) - field)
