r"""How long errors of the lidar's poses last, by what readings of different sensors share.

A bag states how large errors of poses are, not how long one lasts. That shows in the readings
before any graph: with their residuals ``e = F u + noise``, F and u as in ``pose_errors``, collected
over short bins b of time,

.. math::
    a_b = \sum F^T e / \sigma^2, \quad G_b = \sum F^T F / \sigma^2, \quad
    \rho(k) = \frac{\sum_b a_b \cdot a_{b+k}}{\sum_b \mathrm{tr}(G_b G_{b+k})}

is the correlation of u at a distance of k bins, times its variance where that is not the one
stated. Only products of two sensors count: what noise of one sensor has in common with itself is
nothing that poses do. What errors of the map add is known up to how far they reach: at most what
one error of its variance would, the same everywhere.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.pose_errors import error_of_poses, pose_seconds
from l2m_gtsam.calibration.view import QueryableMap, View
from l2m_gtsam.data import FloatArray, IntArray, Readings, Trajectory
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.error_budget import DurationSource, PoseDuration

LAGS = np.array([1, 2, 3, 5, 8, 16, 32, 64, 128])  # bins
BLOCKS = 32  # of a drive: how much the correlation scatters is seen in them
MOST_BINS = 20_000  # of a drive
LEAST_BINS = 20 * BLOCKS  # with fewer a block is no longer than what it is to judge
LEAST_GAIN = 11.0  # in chi-square: 0.1 % of one degree of freedom have more by chance
SHORTEST = 0.25  # of a bin
LONGEST_S = 30.0
TRIED = 48  # durations
MAP_LASTS_S = (0.3, 1.0, 3.0, 10.0)  # on the way through errors of the map
TINY = np.finfo(np.float64).tiny
COLUMNS = (6, 36, 18)  # of a, of G, and of what an error of the map does


@dataclass(frozen=True)
class SharedErrors:
    """What errors of poses at a distance in time have in common.

    Attributes
    ----------
    lag_s
        Width of a bin in seconds.
    lags
        Distances in bins, shape (K,).
    correlation
        Of the errors, in units of the variance that was stated, shape (K,).
    covariance
        Of that, shape (K, K).
    of_map
        What an error of the map that is the same everywhere would add, shape (K,).
    """

    lag_s: float
    lags: IntArray
    correlation: FloatArray
    covariance: FloatArray
    of_map: FloatArray

    def expected(self, seconds: FloatArray) -> FloatArray:
        """Return the correlation if errors last so long, shape (T, K) for T durations."""
        # The mean of exp(-|tau| / T) over two bins: a product of their distance and their widths.
        width = self.lag_s / np.atleast_1d(seconds)[:, None]
        return np.asarray(np.exp(-self.lags * width) * np.square(np.sinh(width / 2) / (width / 2)))

    def misfits(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return chi-square if errors last so long: of the size stated and of any, shapes (T,)."""
        L = cholesky(self.covariance, lower=True)
        data = solve_triangular(L, self.correlation, lower=True)
        of_map = self.of_map * self.expected(np.array(MAP_LASTS_S))
        own = solve_triangular(L, self.expected(seconds).T, lower=True).T[:, None]
        beside = solve_triangular(L, of_map.T, lower=True).T[None]

        def share(left: FloatArray, of: FloatArray) -> FloatArray:
            """Return how much of one there is in what is left, shape (T, M, 1)."""
            squares = np.maximum((of * of).sum(axis=-1, keepdims=True), TINY)
            return np.asarray((left * of).sum(axis=-1, keepdims=True) / squares)

        def squared(left: FloatArray) -> FloatArray:
            """Return the least chi-square over how long errors of the map last, shape (T,)."""
            # A covariance that comes from n blocks is no exact one (Hartlap et al. 2007).
            exact = (BLOCKS - len(self.lags) - 2) / (BLOCKS - 1)
            return exact * np.asarray((left * left).sum(axis=-1).min(axis=-1))

        as_stated = data - own
        as_stated = as_stated - np.clip(share(as_stated, beside), 0.0, 1.0) * beside
        # Of any size: inside the bounds, where what is left is orthogonal to both, or on an edge.
        apart = own - share(own, beside) * beside
        size = np.maximum(share(data, apart), 0.0)
        mapped = np.clip(share(data - size * own, beside), 0.0, 1.0)
        ways = [squared(data - size * own - mapped * beside)]
        for held in (0.0, 1.0):
            left = data - held * beside
            ways.append(squared(left - np.maximum(share(left, own), 0.0) * own))
        return squared(as_stated), np.min(ways, axis=0)


def duration_of_poses(
    view: View,
    field_map: QueryableMap,
    near: Estimate,
    options: PoseNoiseOptions,
    trajectory: Trajectory | None = None,
) -> PoseDuration | None:
    """Return how long errors of poses last; None where poses are taken as exact.

    Parameters
    ----------
    view
        The readings that count.
    field_map
        The map.
    near
        The optimum with independent errors.
    options
        What was stated.
    trajectory
        The poses. Between two of them readings have errors of both: what is stated to last less
        lasts half the time from one to the next, where the sum over time is that of errors which
        all poses have of their own.
    """
    if view.readings.pose_root is None:
        return None
    if options.correlation_s is not None:
        steps_ns = np.zeros(1) if trajectory is None else np.diff(trajectory.stamp_ns)
        least_s = 0.5e-9 * float(np.median(steps_ns))
        return PoseDuration(max(options.correlation_s, least_s), DurationSource.GIVEN)
    found = None
    if shared := shared_errors(view, field_map, near):
        found = most_likely(shared, options.lasting_s)
    if found is None:
        return PoseDuration(options.lasting_s, DurationSource.ASSUMED)
    return PoseDuration(found, DurationSource.FOUND)


def most_likely(shared: SharedErrors, assumed_s: float) -> float | None:
    """Return how long errors last; None if readings do not contradict what is assumed.

    Errors have the size that was stated, unless no duration explains them so.

    Parameters
    ----------
    shared
        What errors have in common.
    assumed_s
        Duration that is assumed, seconds.
    """
    tried = np.geomspace(SHORTEST * shared.lag_s, LONGEST_S, TRIED)
    as_stated, of_any_size = shared.misfits(tried)
    assumed, assumed_of_any_size = shared.misfits(np.array([assumed_s]))
    # Of errors shorter than a bin only the product of size and duration shows.
    longer = tried >= shared.lag_s
    if as_stated.min() - of_any_size[longer].min() > LEAST_GAIN:
        as_stated, assumed = np.where(longer, of_any_size, np.inf), assumed_of_any_size
    if assumed[0] - as_stated.min() < LEAST_GAIN:
        return None
    return float(tried[as_stated.argmin()])


def shared_errors(view: View, field_map: QueryableMap, near: Estimate) -> SharedErrors | None:
    """Return what errors of poses have in common; None if readings are too few to tell.

    Parameters
    ----------
    view, field_map, near
        As of ``duration_of_poses``.
    """
    if len(view.sensors) < 2:
        return None
    readings = view.readings
    s = readings.sensor
    e = readings.field - near.distortion[s, 9:] - np.einsum("nij,nj->ni", near.C()[s], view.b_lidar)
    F = near.C()[s] @ error_of_poses(readings, field_map, near)
    weight = view.trust / np.square(readings.noise(near.noise))
    a = np.einsum("n,nij,ni->nj", weight, F, e)
    G = np.einsum("n,nij,nik->njk", weight, F, F).reshape(-1, 36)
    of_map = np.sqrt(view.map_variance.mean(axis=1))
    K = np.einsum("n,nij,nik->njk", weight * of_map, F, near.C()[s]).reshape(-1, 18)
    values, seconds, lag_s = np.column_stack([a, G, K]), pose_seconds(readings), _width(readings)
    parts = [
        _products(values[rows], seconds[rows], s[rows], lag_s)
        for rows in _drives(readings)
        if np.ptp(seconds[rows]) > LEAST_BINS * lag_s
    ]
    if not parts:
        return None
    found, expected, mapped = np.sum(parts, axis=0)
    whole = expected.sum(axis=0)
    if (whole <= 0).any():
        return None
    # Delete-one jackknife over blocks of the drives.
    left = (found.sum(axis=0) - found) / (whole - expected)
    scatter = left - left.mean(axis=0)
    return SharedErrors(
        lag_s=lag_s,
        lags=LAGS,
        correlation=found.sum(axis=0) / whole,
        covariance=(BLOCKS - 1) / BLOCKS * scatter.T @ scatter,
        of_map=np.maximum(mapped.sum(axis=0) / whole, 0.0),
    )


def _drives(readings: Readings) -> Iterator[IntArray]:
    """Return the rows of each drive."""
    return (np.flatnonzero(readings.of_drive == each) for each in np.unique(readings.of_drive))


def _width(readings: Readings) -> float:
    """Return the time from one reading of a sensor to the next in seconds, or more."""
    same = (np.diff(readings.sensor) == 0) & (np.diff(readings.stamp_ns) > 0)
    between = 1e-9 * np.diff(readings.stamp_ns)[same]
    seconds = pose_seconds(readings)
    longest = max(float(np.ptp(seconds[rows])) for rows in _drives(readings))
    return max(float(np.median(between)) if len(between) else 0.0, longest / MOST_BINS)


def _products(
    values: FloatArray, seconds: FloatArray, sensor: IntArray, lag_s: float
) -> FloatArray:
    """Return products of bins of different sensors: of a, of G, and of errors of the map.

    Parameters
    ----------
    values
        Of each reading of a drive, side by side, shape (N, sum of COLUMNS).
    seconds, sensor
        When and whose they are, shapes (N,).
    lag_s
        Width of a bin.

    Returns
    -------
    By block and lag, shape (3, BLOCKS, K).
    """
    at = ((seconds - seconds.min()) / lag_s).astype(np.int64)
    count = int(at.max()) + 1
    every: FloatArray = np.zeros((count, values.shape[1]))
    products = np.zeros((len(COLUMNS), BLOCKS, len(LAGS)))
    for each in np.unique(sensor):
        rows = np.flatnonzero(sensor == each)
        own: FloatArray = np.column_stack([np.bincount(at[rows], v, count) for v in values[rows].T])
        every += own
        products -= _lagged(own)
    return np.asarray(products + _lagged(every))


def _lagged(bins: FloatArray) -> FloatArray:
    """Return sums of products of bins by kind, block and lag, shape (3, BLOCKS, K)."""
    block = np.arange(len(bins)) * BLOCKS // len(bins)
    sums = np.empty((len(COLUMNS), BLOCKS, len(LAGS)))
    for part, kind in enumerate(np.split(bins, np.cumsum(COLUMNS)[:-1], axis=1)):
        for column, k in enumerate(LAGS):
            product = np.einsum("bi,bi->b", kind[:-k], kind[k:])
            sums[part, :, column] = np.bincount(block[:-k], product, BLOCKS)
    return sums
