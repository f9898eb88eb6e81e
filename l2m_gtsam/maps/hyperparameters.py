"""KernelHyperparameters of the Gaussian process, learnt from the marginal likelihood.

The logarithm of the evidence of one neighbourhood of N readings, summed over the three axes that
share the kernel, with K = s^2 E + n^2 D and r the readings less their mean (Rasmussen and
Williams, Gaussian Processes for Machine Learning, 2006, equations 2.30 and 5.9):

    log p          = -1/2 sum_i r_i^T K^-1 r_i - 3/2 log |K| - 3/2 N log 2 pi
    dlog p/dtheta  = 1/2 tr((sum_i alpha_i alpha_i^T - 3 K^-1) dK/dtheta),   alpha_i = K^-1 r_i

where E holds exp(-d^2 / 2 l^2) and D is diagonal, one over the weight of each row.
"""

from dataclasses import dataclass
from itertools import compress

import numpy as np
from pydantic import Field
from scipy.linalg import lapack
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist, pdist

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.training import ThinningOptions, TrainingSet, thinned
from l2m_gtsam.options import Options
from l2m_gtsam.solve.minimum import minimised, on_bound

NAMES = ("length_scale", "signal", "noise")
AXES = 3
ROUNDS = 3  # thinning depends on the length scale and the length scale on what was thinned
SETTLED = 1.25  # ratio of length scales between rounds below which thinning hardly changes
SPREAD = 4  # readings are drawn from this many times as many nearest ones, see draw_neighbourhoods
LEAST_SIGNAL = 1e-3  # uT, below which readings do not vary
SHORTEST = 2e-3  # m, the least length scale that is tried
PAIRED = 1500  # readings whose pairs give the start: a million distances


class KernelHyperparameters(Options):
    """What the Gaussian process assumes of the field and of the sensor."""

    length_scale: float = Field(ge=1e-3, le=1e6)
    """Metres over which the field changes."""

    signal: float = Field(ge=1e-6, le=1e7)
    """Prior standard deviation of the field about its mean, per axis, in microtesla."""

    noise: float = Field(ge=1e-9, le=1e7)
    """Standard deviation of one reading, per axis, in microtesla."""


class KernelLearningOptions(Options):
    """How much data the marginal likelihood is computed from."""

    neighbourhoods: int = Field(default=12, ge=1, le=50)
    """Neighbourhoods drawn at random, whose likelihoods are added."""

    readings: int = Field(default=300, ge=20, le=1000)
    """Readings of each, after thinning; the cost grows with the cube."""

    seed: int = Field(default=0, ge=0)
    """Seed of the draw."""


@dataclass(frozen=True)
class LikelihoodFit:
    """How learning ended.

    Attributes
    ----------
    hyperparameters
        Length scale in metres, signal and noise in uT, of largest likelihood.
    start
        Where the search started, from the pairwise differences of readings.
    log_likelihood
        Sum over the neighbourhoods at the end.
    readings
        Number of readings in all neighbourhoods.
    converged
        Whether the search ended at a maximum inside the bounds.
    at_bound
        Names of hyperparameters that ended on a bound: the data do not determine them.
    message
        Status text of the optimiser.
    """

    hyperparameters: KernelHyperparameters
    start: KernelHyperparameters
    log_likelihood: float
    readings: int
    converged: bool
    at_bound: tuple[str, ...]
    message: str


@dataclass(frozen=True)
class Neighbourhood:
    """Readings whose joint likelihood is computed exactly.

    Attributes
    ----------
    squared_distance
        Between all pairs in square metres, shape (N, N).
    residual
        Readings less the mean of the map in microtesla, shape (N, 3).
    weight
        How many independent readings each row is worth, shape (N,).
    """

    squared_distance: FloatArray
    residual: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class KernelLikelihood:
    """A log marginal likelihood and its gradient in log(length_scale, signal, noise), (3,)."""

    value: float
    gradient: FloatArray


def neighbourhood(readings: TrainingSet, mean: FloatArray) -> Neighbourhood:
    """Return readings as one neighbourhood about a mean, shape (3,), in microtesla."""
    squared = cdist(readings.points, readings.points, "sqeuclidean")
    return Neighbourhood(squared, readings.field - mean, readings.weight)


def log_likelihood(near: Neighbourhood, hyperparameters: KernelHyperparameters) -> KernelLikelihood:
    """Return the log marginal likelihood of one neighbourhood.

    Raises
    ------
    MapError
        If the covariance of the readings is not positive definite.
    """
    N = len(near.weight)
    scaled_squared = near.squared_distance / hyperparameters.length_scale**2
    signal = hyperparameters.signal**2 * np.exp(-0.5 * scaled_squared)
    noise = hyperparameters.noise**2 / near.weight
    L, failed = lapack.dpotrf(signal + np.diag(noise), lower=True, overwrite_a=True)
    if failed:
        raise MapError(not_definite(hyperparameters))
    alpha, _ = lapack.dpotrs(L, near.residual, lower=True)
    lower, _ = lapack.dpotri(L, lower=True)
    inverse = np.tril(lower) + np.tril(lower, -1).T
    # dL/dp = tr((a a^T - K^-1) dK/dp) / 2 (Rasmussen and Williams 2006, equation 5.9); the three
    # axes share K, hence their sum.
    evidence = alpha @ alpha.T - AXES * inverse
    weighted = evidence * signal
    value = -0.5 * np.sum(near.residual * alpha)
    value -= AXES * (np.sum(np.log(np.diag(L))) + 0.5 * N * np.log(2 * np.pi))
    gradient = np.array(
        [
            0.5 * np.sum(weighted * scaled_squared),
            np.sum(weighted),
            np.sum(np.diag(evidence) * noise),
        ]
    )
    return KernelLikelihood(float(value), gradient)


def not_definite(hyperparameters: KernelHyperparameters) -> str:
    """Return the sentence for readings whose covariance cannot be factorised."""
    return (
        "the covariance of the map's training readings is not positive definite at noise "
        f"{hyperparameters.noise:g} uT and signal {hyperparameters.signal:g} uT; a larger noise "
        "or spacing is needed"
    )


def learn(
    readings: TrainingSet, options: KernelLearningOptions, thinning: ThinningOptions
) -> LikelihoodFit:
    """Return the hyperparameters that make the readings most likely.

    Parameters
    ----------
    readings
        Readings, not yet thinned, map frame, metres and uT.
    options
        Size of the sample that is looked at.
    thinning
        Of the sample, as the map will do.

    Raises
    ------
    MapError
        If the readings do not vary at all.
    """
    fit = maximise(readings, start_from_pairs(readings, options.seed), options, thinning)
    for _ in range(ROUNDS - 1):
        ratio = fit.hyperparameters.length_scale / fit.start.length_scale
        if thinning.spacing == 0.0 or 1 / SETTLED < ratio < SETTLED:
            break
        fit = maximise(readings, fit.hyperparameters, options, thinning)
    return fit


def start_from_pairs(readings: TrainingSet, seed: int) -> KernelHyperparameters:
    """Return a start from half the squared differences of readings against their distance.

    For this kernel they are noise^2 + signal^2 (1 - exp(-d^2 / 2 l^2)): the noise at distance
    zero, and 39 % of the signal at one length scale.
    """
    rng = np.random.default_rng(seed)
    rows = rng.permutation(len(readings))[:PAIRED]
    signal = spread(readings)
    if signal < LEAST_SIGNAL:
        raise MapError("all map training readings are equal; a field that varies is needed")
    extent = float(np.ptp(readings.points, axis=0).max())
    distance = pdist(readings.points[rows])
    half_squared = 0.5 * pdist(readings.field[rows], "sqeuclidean") / AXES
    order = np.argsort(distance)
    parts = np.array_split(order, min(200, len(order)))
    # Half the mean square of differences over distance is the variogram: it rises from the noise at
    # no distance to the signal beyond the length scale.
    at = np.array([distance[part].mean() for part in parts])
    level = np.array([half_squared[part].mean() for part in parts])
    # At one length scale the kernel has fallen to exp(-1/2), the variogram risen to 0.39 of the
    # signal.
    reached = int(np.argmax(level >= min(0.39 * signal**2, level.max())))
    length_scale = max(float(at[reached]), 1e-3 * extent, SHORTEST)
    noise = float(np.clip(np.sqrt(level[0]), 1e-2 * signal, 0.5 * signal))
    return KernelHyperparameters(length_scale=length_scale, signal=signal, noise=noise)


def spread(readings: TrainingSet) -> float:
    """Return the standard deviation of the readings over the three axes in microtesla."""
    return float(np.sqrt(readings.field.var(axis=0).mean()))


def maximise(
    readings: TrainingSet,
    start: KernelHyperparameters,
    options: KernelLearningOptions,
    thinning: ThinningOptions,
) -> LikelihoodFit:
    """Return the maximum of the summed likelihood of neighbourhoods drawn at random."""
    sample = thinned(readings, start.length_scale, thinning)
    drawn = draw_neighbourhoods(sample, options)
    # In logarithms all three are unbounded, and the search does not depend on their units.
    x0 = np.log([start.length_scale, start.signal, start.noise])
    low, high = log_bounds(sample)

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        parts = [log_likelihood(near, from_log(x)) for near in drawn]
        total = sum(part.value for part in parts)
        return -total, -np.sum([part.gradient for part in parts], axis=0)

    x0 = np.clip(x0, low, high)
    end = minimised(cost, x0, low, high)
    at_bound = tuple(compress(NAMES, on_bound(end.x, low, high)))
    return LikelihoodFit(
        hyperparameters=from_log(end.x),
        start=start,
        log_likelihood=-float(end.fun),
        readings=sum(len(near.weight) for near in drawn),
        converged=bool(end.success) and not at_bound,
        at_bound=at_bound,
        message=str(end.message),
    )


def from_log(x: FloatArray) -> KernelHyperparameters:
    """Return hyperparameters from their logarithms, shape (3,)."""
    return KernelHyperparameters(**dict(zip(NAMES, np.exp(x).tolist(), strict=True)))


def log_bounds(readings: TrainingSet) -> FloatArray:
    """Return lower and upper bounds of the logarithms, shape (2, 3).

    A length scale below half the distance of neighbouring readings, or beyond a few times the
    extent, leaves no trace in the data; a noise below 1e-4 of the signal leaves the factorisation
    too few digits. Signal and noise are measured against the spread of the readings.
    """
    nearest, _ = cKDTree(readings.points).query(readings.points, k=[2])
    extent = float(np.linalg.norm(np.ptp(readings.points, axis=0)))
    closest = max(0.5 * float(np.median(nearest)), 1e-4 * extent, SHORTEST)
    low = [closest, 1e-2 * spread(readings), 1e-3 * spread(readings)]
    high = [3 * extent, 10 * spread(readings), 10 * spread(readings)]
    return np.log([low, high])


def draw_neighbourhoods(
    readings: TrainingSet, options: KernelLearningOptions
) -> tuple[Neighbourhood, ...]:
    """Return random readings around centres drawn at random, or all where they are few.

    The nearest readings to a centre would lie on one or two passes, whose common errors then
    look like a field of short length scale; drawn from a wider circle they compare passes.
    """
    rng = np.random.default_rng(options.seed)
    size = min(options.readings, len(readings))
    pool = min(SPREAD * size, len(readings))
    number = min(options.neighbourhoods, -(-len(readings) // size))
    centres = readings.points[rng.choice(len(readings), number, replace=False)]
    _, nearest = cKDTree(readings.points).query(centres, k=pool)
    rows = rng.permuted(nearest, axis=1)[:, :size]
    return tuple(neighbourhood(readings[near], readings.mean) for near in rows)
