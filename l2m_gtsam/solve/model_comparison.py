r"""Which model of a magnetometer its readings ask for: held-out segments and the BIC.

Readings next to each other share the errors of the map. What is left of them is correlated, and a
regressor that varies as slowly finds some of it to explain, whatever it is, again in every
neighbour: the likelihood of N independent readings gains in proportion to the rate of reading, the
penalty of the BIC only with its logarithm, so that the largest model would win. Two remedies are
taken together.

1. *Held out.* The drive is cut into segments; each is predicted by fits to the others. The score is
   the mean logarithm of the density of a reading; differences between models vary over the
   segments, which gives their standard error.
2. *BIC for correlated residuals.* What is left of readings k apart has the correlation rho_k. The
   penalty counts each parameter as often as the variance of its estimate exceeds that with
   independent residuals (X. Gao, P. X.-K. Song, "Composite likelihood Bayesian information
   criteria", 2010): many times where its regressor varies as slowly as the map's errors, once where
   it is quick. Differences are divided by that factor to read as odds.

``choose`` states how the two decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.options import Options
from l2m_gtsam.records.sensor_models import ONE_DRIVE, Model, ModelComparison, ModelFigures, Samples
from l2m_gtsam.solve.model_fits import Fit, Spread, compress, fit_model, inflation, spread_of
from l2m_gtsam.solve.noise import rms

PER_COLUMN = 4  # readings, at the least
PER_SEGMENT = 4


@dataclass(frozen=True)
class HeldOut:
    """How a model predicts segments that it was not fitted to.

    Attributes
    ----------
    rms
        Of the errors per axis in uT, over all of them.
    scores
        Mean logarithm of the density of a reading in 1/uT^3 in each of S segments, shape (S,).
    """

    rms: float
    scores: FloatArray


@dataclass(frozen=True)
class Trial:
    """A model with all that it is judged by."""

    model: Model
    fit: Fit
    spread: Spread
    rms: float
    held_out: HeldOut
    bic: float

    def lead(self, other: "Trial") -> tuple[float, float]:
        """Return by how much another's score is behind, and the standard error of that."""
        difference = self.held_out.scores - other.held_out.scores
        return float(difference.mean()), standard_error(difference)

    def above(self, least: "Trial") -> float:
        """Return how much more its BIC is than the least, in units that read as odds."""
        more = self.fit.parameters - least.fit.parameters
        counted = (
            (self.spread.freedom - least.spread.freedom) / more
            if more
            else self.spread.freedom / self.fit.parameters
        )
        return (self.bic - least.bic) / max(counted, 1.0)


@dataclass(frozen=True)
class Choice:
    """The recommended model beside those that it is judged by.

    Attributes
    ----------
    chosen
        Recommended model.
    best
        Of those that the BIC admits, the one that predicts held-out segments best.
    least
        Model of least BIC.
    """

    chosen: Trial
    best: Trial
    least: Trial


def choose(trials: list[Trial], strong: float) -> Choice:
    """Return the simplest adequate model.

    Parameters
    ----------
    trials
        Models from few parameters to many.
    strong
        By how much a BIC above the least rejects a model.
    """
    least = min(trials, key=lambda trial: trial.bic)
    admitted = [trial for trial in trials if trial.above(least) <= strong]
    best = max(admitted, key=lambda trial: trial.held_out.scores.mean())
    near = [trial for trial in admitted if _is_near(best, trial)]
    return Choice(min(near, key=lambda trial: trial.fit.parameters), best, least)


def _is_near(best: Trial, trial: Trial) -> bool:
    behind, error = best.lead(trial)
    return behind <= error


def standard_error(values: FloatArray) -> float:
    """Return the standard error of the mean over segments, shape (S,)."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


def reason_of(choice: Choice, trials: list[Trial]) -> str:
    """Return why a model is recommended, as a sentence."""
    chosen, best = choice.chosen, choice.best
    why = f"{chosen.model} predicts held-out segments best"
    if chosen is not best:
        why = f"{chosen.model} predicts held-out segments as well as {best.model} does"
        why += f" ({_deficit(best, chosen)})"
    simpler = [t for t in trials if t.fit.parameters < chosen.fit.parameters]
    if not simpler:
        return why
    next_ = max(simpler, key=lambda trial: trial.fit.parameters)
    above = next_.above(choice.least)
    return f"{why}; {next_.model} is {_deficit(best, next_)}, its BIC {above:.0f} above the least"


def _deficit(best: Trial, trial: Trial) -> str:
    behind, error = best.lead(trial)
    return f"{behind:.2g} per reading behind, with a standard error of {error:.2g}"


class ModelOptions(Options):
    """How models of a magnetometer are compared."""

    segments: int = Field(default=8, ge=3, le=50)
    """Parts of the drive, of equally many readings, of which each is held out once."""
    strong: float = Field(default=10.0, gt=0)
    """A BIC so far above the least rejects a model: odds of 150 to 1 (R. E. Kass, A. E. Raftery,
    "Bayes factors", 1995)."""


def compare_models(samples: Samples, options: ModelOptions) -> ModelComparison:
    """Compare nested models on the readings of one sensor.

    Parameters
    ----------
    samples
        N readings of one sensor in uT, in order of time.
    options
        Number of segments and BIC difference that rejects a model.

    Raises
    ------
    CalibrationError
        There are too few readings, or numbers or weights that make no sense.
    """
    check_samples(samples, options)
    models = models_for(samples)
    whole = compress(samples)
    fits = {model: fit_model(model, whole) for model in models}
    left = fits[models[-1]].coefficients.residual(samples)
    correlation = correlation_of(np.sqrt(samples.weights)[:, None] * left, samples.drives)
    root = inflation(whole, correlation, samples.drives)
    segment = segments_of(samples, options.segments)
    held_out = predicted(samples, segment, models)
    trials = [
        trial_of(samples, model, fit, spread_of(fit, whole, root), held_out[model])
        for model, fit in fits.items()
    ]
    choice = choose(trials, options.strong)
    return ModelComparison(
        fits=tuple(_figures(trial, choice) for trial in trials),
        regressors=samples.names,
        readings=len(samples),
        independent=len(samples) / float(2 * correlation.sum() - 1),
        segments=int(segment[-1]) + 1,
        recommended=choice.chosen.model,
        reason=reason_of(choice, trials),
        coefficients=choice.chosen.fit.coefficients,
        sigma=choice.chosen.spread.sigma,
    )


def models_for(samples: Samples) -> list[Model]:
    """Return the models that there are numbers and rates for, from few parameters to many."""
    regressors, rates = bool(samples.names), bool(samples.db_dt.any())
    return [
        model
        for model in Model
        if (regressors or not model.has_regressors) and (rates or not model.has_eddy)
    ]


def trial_of(samples: Samples, model: Model, fit: Fit, spread: Spread, held_out: HeldOut) -> Trial:
    """Return a model with its rms and its BIC."""
    values = samples.z.size
    # Schwarz 1978, with the effective number of parameters in place of their count, as residuals
    # are correlated.
    bic = values * np.log(fit.squares / values) + spread.freedom * np.log(values)
    left = fit.coefficients.residual(samples)
    return Trial(model, fit, spread, rms(left), held_out, float(bic))


def check_samples(samples: Samples, options: ModelOptions) -> None:
    """Refuse what no model can be fitted to.

    Raises
    ------
    CalibrationError
        One line that states what is wrong.
    """
    parts = {"readings": samples.z, "predicted fields": samples.b, "rates": samples.db_dt}
    parts |= {f"regressor {name!r}": samples.q[:, k] for k, name in enumerate(samples.names)}
    for what, values in parts.items():
        if not np.isfinite(values).all():
            raise CalibrationError(f"models: {what}: some are not finite; leave these readings out")
    if not (np.isfinite(samples.weights) & (samples.weights > 0)).all():
        raise CalibrationError("models: every reading needs a finite weight above 0")
    columns = samples.columns().shape[1]
    needed = max(PER_COLUMN * (1 + columns), PER_SEGMENT * options.segments)
    if len(samples) < needed:
        raise CalibrationError(
            f"models: {len(samples)} readings cannot distinguish models of {columns} columns in "
            f"{options.segments} segments, at least {needed} are needed"
        )


def correlation_of(residual: FloatArray, drives: Sequence[slice] = ONE_DRIVE) -> FloatArray:
    """Return the correlation of residuals no, one, two, ... readings apart, shape (N,).

    It is zero from the first that is not positive: after that there is only noise in them.

    Parameters
    ----------
    residual
        Weighted, in order of time, shape (N, 3).
    drives
        Rows of each drive: readings of two drives count as uncorrelated.
    """
    covariance = np.zeros(len(residual))
    for rows in drives:
        own = residual[rows]
        n = len(own)
        # Wiener and Khinchin: the autocovariance is the transform of the power. Twice the length,
        # so that the end does not meet the beginning.
        power = np.abs(np.fft.rfft(own, 2 * n, axis=0)) ** 2
        covariance[:n] += np.fft.irfft(power, 2 * n, axis=0)[:n].sum(axis=1)
    # Beyond the first zero an estimated correlation is chance.
    covariance[np.cumsum(covariance <= 0) > 0] = 0.0
    covariance[0] = max(covariance[0], np.finfo(float).tiny)
    return np.asarray(covariance / covariance[0])


def segments_of(samples: Samples, segments: int) -> IntArray:
    """Return the segment of each reading, shape (N,): each of one drive, each drive with one."""
    segment, first = np.empty(len(samples), dtype=np.int64), 0
    for rows in samples.drives:
        n = rows.stop - rows.start
        own = min(max(round(segments * n / len(samples)), 1), n)  # none is empty
        segment[rows] = first + np.arange(n) * own // n
        first = int(segment[rows.stop - 1]) + 1
    return segment


def predicted(samples: Samples, segment: IntArray, models: list[Model]) -> dict[Model, HeldOut]:
    """Return how each model, fitted to the other segments, predicts each segment."""
    segments = int(segment[-1]) + 1
    residual = {model: np.empty_like(samples.z) for model in models}
    scores = {model: np.empty(segments) for model in models}
    for k in range(segments):
        others, held_out = compress(samples[segment != k]), samples[segment == k]
        for model in models:
            fit = fit_model(model, others)
            e = fit.coefficients.residual(held_out)
            residual[model][segment == k] = e
            scores[model][k] = np.mean(_log_density(e, fit.variance / held_out.weights))
    return {model: HeldOut(rms(residual[model]), scores[model]) for model in models}


def _log_density(residual: FloatArray, variance: FloatArray) -> FloatArray:
    """Return it for residuals in uT, shape (N, 3), of variances per axis in uT^2, shape (N,)."""
    squares = np.sum(residual**2, axis=1) / variance
    return np.asarray(-0.5 * (squares + 3 * np.log(2 * np.pi * variance)))


def _figures(trial: Trial, choice: Choice) -> ModelFigures:
    behind, error = choice.best.lead(trial)
    return ModelFigures(
        model=trial.model,
        parameters=trial.fit.parameters,
        rms=trial.rms,
        held_out_rms=trial.held_out.rms,
        held_out_score=float(trial.held_out.scores.mean()),
        score_error=standard_error(trial.held_out.scores),
        behind=behind,
        behind_error=error,
        bic=trial.bic,
        bic_above=trial.above(choice.least),
    )
