r"""Readings that the model cannot explain: how far to trust each.

With the squared length r^2 of a whitened residual and the largest c^2 that noise leaves, the
truncated loss min(r^2, c^2) is approached by graduated non-convexity (H. Yang, P. Antonante,
V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception", 2020): for a
growing mu a reading weighs

.. math::
    w = 1 \;\text{if}\; r^2 \le \tfrac{\mu}{\mu + 1} c^2, \quad
    w = 0 \;\text{if}\; r^2 \ge \tfrac{\mu + 1}{\mu} c^2, \quad
    w = \tfrac{c}{r} \sqrt{\mu (\mu + 1)} - \mu \;\text{between}.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import Field
from scipy.ndimage import label, uniform_filter1d
from scipy.spatial import cKDTree

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings
from l2m_gtsam.options import Options
from l2m_gtsam.records.calibration import Disagreement, Return
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.noise import NOISE_RANGE

AXES = 3
MEDIAN = float(quantile(0.5, AXES))  # of r^2 where only noise is left
TINY = 1e-12  # squared length of a whitened residual: keeps the division finite
FIRST_ROUNDS = 10  # of least absolute deviations: an outlier pulls no more than a good reading
TRIMMINGS = 30
WINDOWS = (9, 25)  # readings of a mean
# Beside rejected readings a mean is taken for wrong at a lower threshold.
LEAST_TOGETHER = float(quantile(0.99, AXES))
SEEDS = 3  # readings wrong by themselves that make a stretch of what lies about them
SMALL = 1e-3  # of the median length: residuals shorter than that weigh alike


class Loss(StrEnum):
    """What a residual costs."""

    TRUNCATED = "truncated"
    HUBER = "huber"
    CAUCHY = "cauchy"
    SQUARED = "squared"


class RobustOptions(Options):
    """How readings are treated that the model cannot explain."""

    loss: Loss = Loss.TRUNCATED
    """`truncated` (they are rejected and named, by graduated non-convexity), `huber` or `cauchy`
    (they pull less, none is rejected), or `squared` (all count in full)."""
    confidence: float = Field(default=0.9999, gt=0.9, lt=1)
    """Of readings with nothing but noise so many are taken for good."""

    @property
    def largest(self) -> float:
        """Largest squared length of a whitened residual that passes for noise."""
        return self.largest_of(AXES)

    def largest_of(self, components: int) -> float:
        """Return the same for residuals of so many components."""
        return float(quantile(self.confidence, components))


def truncated_weights(r2: FloatArray, largest: float, mu: float) -> FloatArray:
    """Return the weights of the truncated loss, shape (N,), at a stage of its graduation.

    Parameters
    ----------
    r2
        Squared lengths of whitened residuals, shape (N,).
    largest
        c^2, without unit.
    mu
        Small for a loss that is nearly convex; infinite for the truncated loss itself.
    """
    # Truncated least squares by graduated non-convexity (Yang, Antonante, Tzoumas and Carlone, RA-L
    # 5:2, 2020): mu near 0 is convex, infinity the truncated loss itself.
    if np.isinf(mu):
        return np.asarray(r2 <= largest, dtype=float)
    # Above one up to the lower threshold and negative beyond the upper one: clipping gives all
    # three.
    between = np.sqrt(largest * mu * (mu + 1) / np.maximum(r2, TINY)) - mu
    return np.clip(between, 0.0, 1.0)


def huber_weights(r2: FloatArray, largest: float, mu: float) -> FloatArray:
    """Return the weights of Huber's loss, quadratic up to c; see ``truncated_weights``."""
    return np.sqrt(largest / np.maximum(r2, largest))


def cauchy_weights(r2: FloatArray, largest: float, mu: float) -> FloatArray:
    """Return the weights of Cauchy's loss with the scale c; see ``truncated_weights``."""
    return 1 / (1 + r2 / largest)


def equal_weights(r2: FloatArray, largest: float, mu: float) -> FloatArray:
    """Return ones; see ``truncated_weights``."""
    return np.ones_like(r2)


# Weights psi(r) / r of iteratively reweighted least squares.
WEIGHTS: dict[Loss, Callable[[FloatArray, float, float], FloatArray]] = {
    Loss.TRUNCATED: truncated_weights,
    Loss.HUBER: huber_weights,
    Loss.CAUCHY: cauchy_weights,
    Loss.SQUARED: equal_weights,
}


def median_noise(residual: FloatArray, map_variance: FloatArray) -> float:
    """Return the noise in uT that explains half of the residuals, whatever the other half is.

    Parameters
    ----------
    residual
        Residuals in uT, shape (N, 3).
    map_variance
        Mean variance of the map's prediction in uT^2, shape (N,).
    """
    # A median holds while fewer than half of the readings are wrong; a mean of squares does not.
    # Half of all r^2 = e^2 / (sigma^2 + v) are below a median m where half of all e^2 / m - v are
    # below sigma^2.
    e2 = np.einsum("ni,ni->n", residual, residual)
    variance = float(np.median(e2 / MEDIAN - map_variance))
    return float(np.sqrt(np.clip(variance, *np.square(NOISE_RANGE))))


def consistent(
    columns: FloatArray, field: FloatArray, map_variance: FloatArray, largest: float
) -> BoolArray:
    """Return which readings one distortion explains, up to noise that half of them show, (N,).

    Least absolute deviations give the first distortion; then readings beyond ``largest`` are left
    out and the others fitted again, until the same ones stay.

    Parameters
    ----------
    columns
        Predicted field in the lidar frame in uT, and what else explains readings, of about the
        same size, shape (N, P).
    field
        Readings in uT, shape (N, 3).
    map_variance
        Mean variance of the prediction in uT^2, shape (N,).
    largest
        Largest squared length of a whitened residual that passes for noise.
    """
    # Centred: beside a field of 50 uT the constant would otherwise be nearly collinear.
    regressors = np.column_stack([np.ones(len(columns)), columns - columns.mean(axis=0)])
    e = deviations(regressors, field, np.ones(len(field)))
    # Weights 1 / |e| make least squares minimise the sum of lengths (Schlossmacher 1973); the floor
    # keeps a reading that is fitted exactly from taking all the weight.
    for _ in range(FIRST_ROUNDS):
        length = np.linalg.norm(e, axis=1)
        e = deviations(regressors, field, 1 / np.maximum(length, SMALL * np.median(length)))
    keep = np.ones(len(field), dtype=np.bool_)
    # Refits of the readings kept, as the concentration steps of least trimmed squares (Rousseeuw
    # and Van Driessen 2006).
    for _ in range(TRIMMINGS):
        variance = median_noise(e, map_variance) ** 2 + map_variance
        before, keep = keep, np.einsum("ni,ni->n", e, e) <= largest * variance
        if np.array_equal(keep, before):
            break
        e = deviations(regressors, field, keep / variance)
    return np.asarray(keep)


def deviations(regressors: FloatArray, field: FloatArray, weights: FloatArray) -> FloatArray:
    """Return what a weighted regression leaves of all readings in uT, shape (N, 3)."""
    root = np.sqrt(weights)[:, None]
    X = np.linalg.lstsq(root * regressors, root * field, rcond=None)[0]
    return np.asarray(field - regressors @ X)


def grown(
    rejected: BoolArray, residual: FloatArray, noise: float, map_variance: FloatArray
) -> BoolArray:
    """Return the rejected readings of a drive and those about them that deviate together, (N,).

    Where something was moved the field fades from plainly wrong to right: at the ends of such a
    stretch each reading could be noise, their mean could not.

    Parameters
    ----------
    rejected
        Readings that are wrong by themselves, in order of time, shape (N,).
    residual
        Of all readings in uT, shape (N, 3).
    noise
        Standard deviation of the sensor's noise per axis in uT.
    map_variance
        Mean variance of the map's prediction in uT^2, shape (N,).
    """
    together = np.zeros_like(rejected)
    for window in WINDOWS:
        count = windowed(np.where(rejected, 0.0, 1.0), window)
        total = [windowed(np.where(rejected, 0.0, axis), window) for axis in residual.T]
        mean = np.stack(total, axis=1) / np.maximum(count, 1)[:, None]
        m2 = np.einsum("ni,ni->n", mean, mean)
        # The sensor's noise averages out over a window; the map's error is common to neighbours.
        common = windowed(map_variance, window) / windowed(np.ones(len(mean)), window)
        variance = noise**2 / np.maximum(count, 1) + common
        # A map that errs everywhere, and along the drive, makes no stretch: half of all means pass.
        scale = np.median((m2 / variance)[count > 0]) / MEDIAN if (count > 0).any() else 1.0
        together |= (count > 0) & (m2 > LEAST_TOGETHER * variance * max(scale, 1.0))
    pieces, found = label(rejected | together)
    seeds = np.bincount(pieces, weights=rejected, minlength=found + 1)
    grows = seeds >= SEEDS
    grows[0] = False
    return np.asarray(rejected | grows[pieces])


def windowed(values: FloatArray, window: int) -> FloatArray:
    """Return the sum over a window about each value, shape (N,)."""
    return np.asarray(uniform_filter1d(values, window, mode="constant") * window)


FEWEST = 3  # rejected readings of one sensor in a row: fewer are stray ones
SKIP = 2  # good readings within a run that do not end it
BREAK_S = 1.0  # pause in the readings that ends a run, and between sensors that disagree together
NEAR_M = 0.7  # from a place: there the field is much the same
LATER_S = 5.0  # from one passage to the next


@dataclass(frozen=True)
class JudgedReadings:
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


def disagreements(judged: JudgedReadings) -> tuple[Disagreement, ...]:
    """Return stretches of the drive over which readings were rejected, in order of time.

    Those of several sensors at about the same time are one.
    """
    runs = [
        run for sensor in range(len(judged.readings.sensors)) for run in runs_of(judged, sensor)
    ]
    return tuple(described(judged, rows) for rows in together(judged, runs))


def runs_of(judged: JudgedReadings, sensor: int) -> list[IntArray]:
    """Return the rows of each run of rejected readings of one sensor."""
    own = np.arange(len(judged.rejected))[judged.readings.rows_of(sensor)]
    rows = own[judged.rejected[own]]
    if not len(rows):
        return []
    pause = np.diff(judged.readings.stamp_ns[rows]) > BREAK_S * 1e9
    runs = np.split(rows, np.flatnonzero((np.diff(rows) > SKIP + 1) | pause) + 1)
    return [run for run in runs if len(run) >= FEWEST]


def together(judged: JudgedReadings, runs: list[IntArray]) -> list[IntArray]:
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


def described(judged: JudgedReadings, rows: IntArray) -> Disagreement:
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


def passed_again(judged: JudgedReadings, rows: IntArray) -> Return:
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
