"""The simplest adequate one of nested models, by a rule.

1. Models whose BIC is above the least by more than 10 (an option) are struck out.
2. Of the others, the one that predicts held-out segments best is taken for reference.
3. Recommended is the one with the fewest parameters that is behind it by no more than the standard
   error of the difference (one-standard-error rule; T. Hastie, R. Tibshirani, J. Friedman, "The
   Elements of Statistical Learning", 2009, section 7.10).

The rule of the book takes the standard error of the best score itself. Segments differ in how well
the map knows them, for all models alike, so that here it is that of the difference.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.sensor_models import Model
from l2m_gtsam.solve.model_fits import Fit, Spread


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
