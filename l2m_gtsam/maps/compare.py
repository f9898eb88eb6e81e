"""Kinds of maps compared on the same readings, in places that none of them has seen.

The area is cut into square patches, which are dealt out to folds. The maps of a fold are built
without its patches and evaluated there. Readings next to each other share the field and the errors
of one passage, so that readings left out one by one would praise every map alike; a patch left out
shows what a map makes of a gap, and whether its variance reflects it.

Noise of a reading: a tenth of the training readings, drawn at random, is kept from every map of a
fold. The noise that makes these most likely, given the map's own variance there, is added to its
variance in the held-out patches. They lie between training readings, so that this is fitted where
the map is good, never where it is judged: z-scores and coverage remain a test.

Held-out readings outside of a map count as if there were no map: for the likelihood they are
predicted by the mean of the training readings, with their variance. The other figures are of the
readings inside, beside their share; as a map that answers less has easier readings to answer, one
rmse is of those inside of all maps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from pydantic import Field, field_validator
from scipy.optimize import minimize_scalar

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.errors import L2MError, MapError
from l2m_gtsam.maps.build import KINDS, MapOptions
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.folds import Fold, FoldOptions, fitting_fold, folds_of, patches_of
from l2m_gtsam.maps.training import TrainingSet, training_set
from l2m_gtsam.solve.noise import rms

COMPARED = tuple(kind for kind in KINDS if kind != "dense_gp")  # that one only checks another
LEAST_NOISE = 1e-3  # uT, finer than magnetometers resolve: no map may claim to be exact
Z_95 = 1.959964  # of a Gaussian, 95 % lie within as many standard deviations

Build = Callable[[FloatArray, FloatArray, str], FieldMap]
"""Returns a map from positions (N, 3) in metres, readings (N, 3) in uT and the name of a kind."""


class CompareOptions(FoldOptions):
    """How kinds of maps are compared."""

    kinds: tuple[str, ...] = Field(default=COMPARED, min_length=1)
    """Names of the kinds."""

    most: int = Field(default=20_000, ge=100)
    """The most readings that are used, taken evenly from all."""

    @field_validator("kinds")
    @classmethod
    def _known(cls, kinds: tuple[str, ...]) -> tuple[str, ...]:
        for kind in kinds:
            MapOptions(kind=kind)
        return kinds


@dataclass(frozen=True)
class KindFigures:
    """How a kind of map did on held-out readings; see the module for what counts where.

    Attributes
    ----------
    log_likelihood
        Mean logarithm of the density of a reading in 1/uT^3, over all readings.
    inside
        Share of the readings that lie inside the map.
    rmse_axes, rmse
        Errors in microtesla of those inside, per axis, shape (3,), and over the three axes.
    rmse_shared
        The same over the readings inside of every kind that works: to compare kinds by; NaN where
        there are none.
    z_std
        Root mean square of error / sigma over readings and axes inside, without unit: consistent
        if 1.
    coverage
        Share of errors inside within the 95 % interval.
    noise
        Noise of a reading that was added in microtesla, root mean square over the folds.
    seconds
        To build one map, mean over the folds.
    """

    log_likelihood: float
    inside: float
    rmse_axes: FloatArray
    rmse: float
    rmse_shared: float
    z_std: float
    coverage: float
    noise: float
    seconds: float


@dataclass(frozen=True)
class KindResult:
    """One kind in a comparison.

    Attributes
    ----------
    kind
        Name of the map kind, a key of ``KINDS``.
    figures
        How it did, absent where it failed.
    reason
        Why it failed, empty where it did not.
    """

    kind: str
    figures: KindFigures | None
    reason: str


@dataclass(frozen=True)
class MapComparison:
    """Kinds of maps on the same readings.

    Attributes
    ----------
    kinds
        One result per kind, in the order that was asked for.
    readings
        Number of readings; each is held out once.
    fold
        Edge of a patch in metres.
    patches, folds
        Number of patches, and of the groups that they were dealt out to.
    recommended
        The kind of highest log-likelihood, absent where all failed.
    reason
        Why that kind is recommended, one sentence.
    """

    kinds: tuple[KindResult, ...]
    readings: int
    fold: float
    patches: int
    folds: int
    recommended: str | None
    reason: str


@dataclass(frozen=True)
class Prediction:
    """Predictions of readings by maps, as errors.

    Attributes
    ----------
    error
        Reading less prediction in microtesla, shape (N, 3).
    variance
        That was claimed for it, with the noise, in square microtesla, shape (N, 3).
    inside
        Whether a map answered, shape (N,).
    noise
        Noise in it in microtesla, shape (F,), one per fold.
    seconds
        To build the maps, shape (F,).
    """

    error: FloatArray
    variance: FloatArray
    inside: BoolArray
    noise: FloatArray
    seconds: FloatArray

    @property
    def log_likelihood(self) -> FloatArray:
        """Logarithm of the density of each reading, shape (N,)."""
        terms = np.log(2 * np.pi * self.variance) + self.error**2 / self.variance
        return np.asarray(-0.5 * terms.sum(axis=1))


def compare_maps(
    points: FloatArray, field: FloatArray, options: CompareOptions, build: Build
) -> MapComparison:
    """Compare kinds of maps on held-out patches of the readings.

    Parameters
    ----------
    points
        Positions of the readings in the map frame in metres, shape (N, 3).
    field
        Readings in the map frame in microtesla, shape (N, 3).
    options
        Which kinds, and how readings are held out.
    build
        Makes the maps.

    Raises
    ------
    MapError
        If no map can be made of such readings, or they fill too few patches.
    """
    readings = evenly(training_set(points, field), options.most)
    fold = fitting_fold(readings.points, options)
    patch = patches_of(readings.points, fold)
    folds = folds_of(patch, options)
    predictions: dict[str, Prediction] = {}
    failures: dict[str, str] = {}
    for kind in options.kinds:
        try:
            predictions[kind] = predicted(readings, folds, kind, build)
        except L2MError as error:
            failures[kind] = str(error)
    shared = np.all([prediction.inside for prediction in predictions.values()], axis=0)
    figures = {kind: figures_of(found, shared) for kind, found in predictions.items()}
    ranked = sorted(figures, key=lambda kind: figures[kind].log_likelihood, reverse=True)
    return MapComparison(
        kinds=tuple(
            KindResult(kind, figures.get(kind), failures.get(kind, "")) for kind in options.kinds
        ),
        readings=len(readings),
        fold=fold,
        patches=int(patch.max()) + 1,
        folds=options.folds,
        recommended=ranked[0] if ranked else None,
        reason=reason_of([(kind, predictions[kind]) for kind in ranked[:2]], patch),
    )


def evenly(readings: TrainingSet, most: int) -> TrainingSet:
    """Return at most so many readings, spread evenly over their order."""
    rows = np.linspace(0, len(readings) - 1, min(most, len(readings)))
    return readings[np.rint(rows).astype(np.int64)]


def predicted(
    readings: TrainingSet, folds: tuple[Fold, ...], kind: str, build: Build
) -> Prediction:
    """Return what maps of a kind predict for each reading, built without its patch.

    Raises
    ------
    L2MError
        If a map cannot be built, or none has an answer.
    """
    parts = [vars(predicted_fold(readings, fold, kind, build)) for fold in folds]
    every = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not every["inside"].any():
        raise MapError("no held-out reading lies inside the map; smaller patches are needed")
    order = np.argsort(np.concatenate([fold.held_out for fold in folds]))
    of_readings = {name: every[name][order] for name in ("error", "variance", "inside")}
    return Prediction(**every | of_readings)


def predicted_fold(readings: TrainingSet, fold: Fold, kind: str, build: Build) -> Prediction:
    """Return what the map of one fold predicts for the readings held out of it."""
    training, held_out = readings[fold.training], readings[fold.held_out]
    start = perf_counter()
    field_map = build(training.points, training.field, kind)
    seconds = perf_counter() - start
    noise = noise_of(field_map, readings[fold.aside])
    sample = field_map.query(held_out.points)
    inside = sample.inside[:, None]
    without_map = np.maximum(training.field.var(axis=0), LEAST_NOISE**2)
    return Prediction(
        error=held_out.field - np.where(inside, sample.field, training.mean),
        variance=np.where(inside, sample.variance + noise**2, without_map),
        inside=sample.inside,
        noise=np.array([noise]),
        seconds=np.array([seconds]),
    )


def noise_of(field_map: FieldMap, readings: TrainingSet) -> float:
    """Return the noise in microtesla that makes readings most likely besides a map's variance."""
    sample = field_map.query(readings.points)
    squared = (readings.field - sample.field)[sample.inside] ** 2
    variance = sample.variance[sample.inside]
    if not len(squared):
        return LEAST_NOISE

    def cost(log_noise: float) -> float:
        total = variance + np.exp(2 * log_noise)
        return float(np.sum(np.log(total) + squared / total))

    largest = max(float(np.sqrt(squared.mean())), LEAST_NOISE)
    bounds = (np.log(LEAST_NOISE), np.log(10 * largest))
    return float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded").x))


def figures_of(prediction: Prediction, shared: BoolArray) -> KindFigures:
    """Return the figures of predictions of which one at least lies inside.

    Parameters
    ----------
    prediction
        Errors and sigmas in uT at all N readings.
    shared
        Which of them are inside of every map, shape (N,).
    """
    inside = prediction.inside
    error, both = prediction.error[inside], prediction.error[shared]
    z = error / np.sqrt(prediction.variance[inside])
    return KindFigures(
        log_likelihood=float(prediction.log_likelihood.mean()),
        inside=float(inside.mean()),
        rmse_axes=np.sqrt(np.mean(error**2, axis=0)),
        rmse=rms(error),
        rmse_shared=rms(both) if len(both) else np.nan,
        z_std=rms(z),
        coverage=float(np.mean(np.abs(z) <= Z_95)),
        noise=rms(prediction.noise),
        seconds=float(prediction.seconds.mean()),
    )


def reason_of(best: Sequence[tuple[str, Prediction]], patch: IntArray) -> str:
    """Return why the first of the two best kinds is recommended, as a sentence."""
    if not best:
        return "no kind of map works on these readings"
    if len(best) == 1:
        return f"{best[0][0]} is the only kind that works on these readings"
    (first, winner), (second, other) = best
    difference = winner.log_likelihood - other.log_likelihood
    ahead, error = float(difference.mean()), standard_error(difference, patch)
    figures = f"{ahead:.2g} per reading above {second}, with a standard error of {error:.2g}"
    return f"the log-likelihood of {first} is {figures} over the patches" + (
        f": {second} may be as good" if ahead <= error else ""
    )


def standard_error(values: FloatArray, patch: IntArray) -> float:
    """Return the standard error of the mean of values, shape (N,), that patches have in common.

    Values of one patch are taken as one: the sums over the patches are independent, not the
    values (the linearised variance of a ratio over clusters; Cochran, Sampling Techniques, 1977).
    """
    # Readings of a patch are correlated: their sums, not they, count as independent (Liang and
    # Zeger, Biometrika 73:13, 1986).
    sums = np.bincount(patch, values - values.mean())
    patches = len(sums)
    return float(np.sqrt(np.sum(sums**2) * patches / (patches - 1)) / len(values))
