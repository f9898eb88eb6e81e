r"""Models of what a magnetometer reads, from a rotation and an offset to motors and eddy currents.

The largest is linear in its coefficients,

.. math::
    z = C b + H + \sum_k q_k h_k + E \, db/dt + \text{noise},

with numbers q_k that were recorded along the drive (a current, a speed) and the eddy currents of
Tolles and Lawson in the last term. Smaller ones leave terms out or restrict C. A clock that is off
by tau gives E = tau C: the last term holds a time offset, too.
"""

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Self

import numpy as np

from l2m_gtsam.data import FloatArray, InFile, IntArray, Matrix, Row3, RowTable, Vector

ONE_DRIVE = (slice(None),)  # all rows


class Model(StrEnum):
    """What a magnetometer's readings are made of, from few parameters to many."""

    OFFSET = "offset"
    SCALE = "scale"
    FULL = "full"
    REGRESSORS = "full + regressors"
    EDDY = "full + eddy"
    ALL = "full + regressors + eddy"

    @property
    def has_regressors(self) -> bool:
        """Whether recorded numbers take part."""
        return self in (Model.REGRESSORS, Model.ALL)

    @property
    def has_eddy(self) -> bool:
        """Whether the field's rate of change takes part."""
        return self in (Model.EDDY, Model.ALL)


@dataclass(frozen=True)
class Samples(RowTable):
    """Readings of one sensor in order of time, and what could explain them.

    Attributes
    ----------
    z
        Readings in uT, shape (N, 3).
    b
        Field in the lidar frame at the sensor that the map predicts, uT, shape (N, 3).
    db_dt
        Its rate of change along the drive in uT/s, shape (N, 3).
    q
        Recorded numbers at the readings, each in its own unit, shape (N, K).
    weights
        One over the variance of each reading in 1/uT^2, shape (N,).
    names
        Of the K numbers.
    drive
        Which drive each reading is of, ascending, shape (N,); absent if all are of one.
    """

    z: FloatArray
    b: FloatArray
    db_dt: FloatArray
    q: FloatArray
    weights: FloatArray
    names: tuple[str, ...]
    drive: IntArray | None = None

    def __len__(self) -> int:
        return len(self.z)

    @property
    def drives(self) -> tuple[slice, ...]:
        """The rows of each drive."""
        ends = [] if self.drive is None else (np.flatnonzero(np.diff(self.drive)) + 1).tolist()
        return tuple(slice(a, b) for a, b in pairwise([0, *ends, len(self)]))

    def columns(self) -> FloatArray:
        """Return b, q and db/dt side by side, shape (N, 3 + K + 3)."""
        return np.hstack([self.b, self.q, self.db_dt])


def _rows(by_name: dict[str, Row3]) -> FloatArray:
    """Return rows that a file has by name, shape (K, 3); K may be 0."""
    return np.array(list(by_name.values())).reshape(-1, 3)


@dataclass(frozen=True)
class Coefficients:
    """What multiplies what, or a standard deviation of each.

    Attributes
    ----------
    C
        Distortion matrix, shape (3, 3).
    H
        Offset in uT, with all recorded numbers at zero, shape (3,).
    h
        Field of each recorded number in the sensor's frame, uT per unit of it, shape (K, 3).
    E
        Of the eddy currents in seconds, shape (3, 3).
    """

    C: Matrix
    H: Vector
    h: Annotated[FloatArray, InFile(dict[str, Row3], _rows)]
    E: Matrix

    @classmethod
    def of_columns(cls, X: FloatArray, H: FloatArray) -> Self:
        """Return the coefficients of b, q and db/dt, shape (3 + K + 3, 3), and H."""
        return cls(X[:3].T, H, X[3:-3], X[-3:].T)

    def residual(self, samples: Samples) -> FloatArray:
        """Return what is left of readings in uT, shape (N, 3)."""
        explained = samples.b @ self.C.T + samples.q @ self.h + samples.db_dt @ self.E.T
        return np.asarray(samples.z - explained - self.H)


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
    recommended, reason
        The simplest adequate model, and a sentence why.
    readings, independent
        Number of readings used, and of independent ones that they are worth.
    segments
        Number of parts of the drive that were held out in turn.
    regressors
        Names of the recorded numbers.
    fits
        One per model, from few parameters to many.
    coefficients, sigma
        Of the recommended model with their standard deviations, the correlation of residuals taken
        into account; infinite for what the readings do not determine, zero for what the model
        fixes.
    """

    recommended: Model
    reason: str
    readings: int
    independent: float
    segments: int
    regressors: tuple[str, ...]
    fits: tuple[ModelFigures, ...]
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
    h: Vector
    sigma: Vector
