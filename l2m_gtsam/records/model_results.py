"""What comes out of a comparison of models, and what moves along a drive: frozen records."""

from dataclasses import dataclass

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.sensor_models import Coefficients, Model


@dataclass(frozen=True)
class ModelFigures:
    """One model and how it does.

    Attributes
    ----------
    model
        Which.
    parameters
        Number of those that the readings determine.
    rms
        Of what is left of the readings it was fitted to, per axis in uT.
    held_out_rms
        Of what is left of held-out readings, per axis in uT.
    held_out_score
        Mean logarithm of the density of a held-out reading in 1/uT^3.
    score_error
        Standard error of that over the segments.
    behind, behind_error
        By how much the score is less than the best among the models that the BIC admits, and the
        standard error of this difference.
    bic
        For correlated residuals.
    bic_above
        How much more than the least it is, divided by how often the parameters that make the
        difference count.
    """

    model: Model
    parameters: int
    rms: float
    held_out_rms: float
    held_out_score: float
    score_error: float
    behind: float
    behind_error: float
    bic: float
    bic_above: float


@dataclass(frozen=True)
class ModelComparison:
    """Nested models on the readings of one sensor.

    Attributes
    ----------
    fits
        One per model, from few parameters to many.
    regressors
        Names of the recorded numbers.
    readings
        That were used.
    independent
        As how many independent ones they count.
    segments
        Parts of the drive that were held out.
    recommended
        The simplest adequate model.
    reason
        A sentence why.
    coefficients, sigma
        Of the recommended model with their standard deviations, the correlation of residuals taken
        into account; infinite for what the readings do not determine, zero for what the model
        fixes.
    """

    fits: tuple[ModelFigures, ...]
    regressors: tuple[str, ...]
    readings: int
    independent: float
    segments: int
    recommended: Model
    reason: str
    coefficients: Coefficients
    sigma: Coefficients

    def __getitem__(self, model: Model) -> ModelFigures:
        return next(each for each in self.fits if each.model is model)


@dataclass(frozen=True)
class MovingField:
    """What a recorded number adds to the readings of a sensor.

    Attributes
    ----------
    name
        Of the number.
    h
        In the sensor's frame in uT per unit of the number, shape (3,).
    sigma
        Its standard deviations, shape (3,).
    """

    name: str
    h: FloatArray
    sigma: FloatArray
