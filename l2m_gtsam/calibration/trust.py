"""How far the solve trusts each reading: the loop of graduated non-convexity around the graph.

GTSAM's own loop cannot copy factors written in Python. Here the graph is solved anew with the
weights that the residuals of the last solve give, round after round (`solve_one_key`).
"""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.factor_graph import Estimate, batch_readings
from l2m_gtsam.calibration.view import QueryableMap, View, places_of
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, IntArray, Readings
from l2m_gtsam.solve.noise import map_covariance, reading_covariance, whitening
from l2m_gtsam.solve.robust import (
    WEIGHTS,
    JudgedReadings,
    Loss,
    RobustOptions,
    consistent,
    grown,
    median_noise,
)

# Stages of the graduation; what is wrong by far is left out before, so that few are enough.
GRADUATION = (1.0, 10.0, float("inf"))
# From this round on the same readings count: one at the very limit would come and go for ever.
FREEZE = 6
NOTHING = 1e-6  # below this a reading counts as rejected
FEWEST = 12  # readings: with fewer a distortion cannot be separated from outliers


@dataclass(frozen=True)
class Trusted:
    """A view of the readings that count.

    Attributes
    ----------
    view
        Those readings with their weights.
    sensor, weights
        Of all readings of the whole view, shape (N,).
    final
        Whether the graduation is over.
    """

    view: View
    sensor: IntArray
    weights: FloatArray
    final: bool

    def agrees(self, other: "Trusted | None") -> bool:
        """Return whether both leave out the same readings, and will go on to do so."""
        if other is None or len(self.weights) != len(other.weights):
            return False
        same = np.array_equal(self.weights > NOTHING, other.weights > NOTHING)
        return self.final and other.final and same

    def agrees_on(self, sensor: int, other: "Trusted | None") -> bool:
        """Return whether both leave out the same readings of a sensor, and will go on to do so."""
        if other is None:
            return False
        own = [each.weights[each.sensor == sensor] > NOTHING for each in (self, other)]
        return self.final and other.final and np.array_equal(*own)


def plausible(readings: Readings, sample: FieldSample, options: RobustOptions) -> BoolArray:
    """Return which readings one distortion per sensor explains at given places, shape (N,).

    The places need not be right: what half of the readings leave there is taken for noise.

    Parameters
    ----------
    readings
        Of several sensors.
    sample
        What the map says there.
    options
        Of the loss; a squared one takes all readings for plausible.
    """
    keep = np.ones(len(readings), dtype=np.bool_)
    if options.loss is Loss.SQUARED:
        return keep
    R = readings.R_map_lidar
    for sensor in range(len(readings.sensors)):
        own = np.arange(len(readings))[readings.rows_of(sensor)]
        own = own[sample.inside[own]]
        if len(own) >= FEWEST:
            b = np.einsum("nji,nj->ni", R[own], sample.field[own])
            variance = sample.variance[own].mean(axis=1)
            keep[own] = consistent(b, readings.field[own], variance, options.largest)
    return keep


def trusted(
    view: View,
    field_map: QueryableMap,
    estimate: Estimate,
    options: OneKeyOptions,
    round_: int,
    last: Trusted | None,
) -> Trusted:
    """Return the readings that count in a round of the loop.

    Parameters
    ----------
    view
        All usable readings.
    field_map
        The map.
    estimate
        Where residuals are taken.
    options
        Of the loss, and how many readings a sensor needs.
    round_
        Of the loop, from 0.
    last
        Those of the round before.
    """
    if last is not None and round_ >= FREEZE and len(last.weights) == len(view.readings):
        return counting(view, last.weights, options.min_readings, final=True)
    stage = GRADUATION[min(round_, len(GRADUATION) - 1)]
    weights = np.empty(len(view.readings))
    e, ratio = residuals(view.readings, field_map, estimate), view.readings.noise_ratio
    for sensor in view.sensors:
        rows = view.readings.rows_of(sensor)
        # The estimate's noise counts wrong readings in; but no more than half can be wrong.
        variance = view.map_variance[rows].mean(axis=1) / ratio[rows] ** 2
        noise = median_noise(e[rows] / ratio[rows, None], variance)
        if options.sensor_noise_ut is not None:
            noise = max(noise, options.sensor_noise_ut)
        weights[rows] = weigh(view, rows, e[rows], estimate, noise, options.robust, stage)
    return counting(view, weights, options.min_readings, final=bool(np.isinf(stage)))


def weigh(
    view: View,
    rows: slice,
    residual: FloatArray,
    estimate: Estimate,
    noise: float,
    options: RobustOptions,
    mu: float,
) -> FloatArray:
    """Return how far the readings of one sensor count, shape (n,).

    Parameters
    ----------
    view
        All usable readings.
    rows
        Those of the sensor.
    residual
        Theirs in uT, shape (n, 3).
    estimate
        Whose distortion makes residuals white.
    noise
        Of the sensor in uT.
    options
        Of the loss.
    mu
        Stage of the graduation.
    """
    sensor, variance = int(view.readings.sensor[rows.start]), view.map_variance[rows]
    ratio = view.readings.noise_ratio[rows]
    C = np.broadcast_to(estimate.C()[sensor], (len(residual), 3, 3))
    share = map_covariance(C, view.readings.R_map_lidar[rows], variance)
    W = whitening(reading_covariance(noise * ratio, share))
    white = np.einsum("nij,nj->ni", W, residual)
    r2 = np.einsum("ni,ni->n", white, white)
    weights = WEIGHTS[options.loss](r2, options.largest, mu)
    if options.loss is Loss.TRUNCATED and np.isinf(mu):
        rejected = weights < NOTHING
        same = residual / ratio[:, None], noise, variance.mean(axis=1) / ratio**2
        weights[grown(rejected, *same)] = 0.0
    return weights


def counting(view: View, weights: FloatArray, min_readings: int, *, final: bool) -> Trusted:
    """Return a view with weights, shape (N,), without readings that have none."""
    sensor = view.readings.sensor
    count = np.bincount(sensor[weights > NOTHING], minlength=len(view.readings.sensors))
    keep = (weights > NOTHING) & (count >= min_readings)[sensor]
    sensors = [s for s in view.sensors if count[s] >= min_readings]
    kept = replace(view, trust=weights).select(keep, sensors)
    return Trusted(kept, sensor, weights, final)


def residuals(readings: Readings, field_map: QueryableMap, estimate: Estimate) -> FloatArray:
    """Return ``C b + H - z`` of readings at an estimate in uT, shape (N, 3)."""
    if not len(readings):
        return np.empty((0, 3))
    batch = batch_readings(readings, field_map, estimate.distortion)
    values = estimate.positions(batch.sensors)
    return np.asarray(batch.residuals(values, batch.sensors[0]).residual)


def judged(
    readings: Readings, field_map: QueryableMap, estimate: Estimate, rejected: BoolArray
) -> JudgedReadings:
    """Return readings with their places, residuals and the verdict, shape (N,), of the solve."""
    place, left = places_of(readings, estimate.t), residuals(readings, field_map, estimate)
    return JudgedReadings(readings, place, left, rejected)
