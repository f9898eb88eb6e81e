"""What every Gaussian-process map is made of: training readings and hyperparameters."""

from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field, TypeAdapter, ValidationError

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import MapSummary
from l2m_gtsam.maps.hyperparameters import (
    NAMES,
    KernelHyperparameters,
    KernelLearningOptions,
    LikelihoodFit,
    learn,
)
from l2m_gtsam.maps.training import (
    ThinningOptions,
    TrainingSet,
    additional_set,
    joined,
    thinned,
    training_set,
)
from l2m_gtsam.options import Options


class GPOptions(Options):
    """Options common to all Gaussian-process maps; lengths are in length scales."""

    hyperparameters: KernelHyperparameters | None = None
    """Fixed hyperparameters; learnt from the marginal likelihood where absent."""

    learning: KernelLearningOptions = KernelLearningOptions()
    """The sample they are learnt from."""

    thinning: ThinningOptions = ThinningOptions()
    """How close readings are merged."""

    reach: float = Field(default=0.83, gt=0)
    """A point is inside the map when a training reading is this near. At sqrt(log 2) = 0.83
    length scales one noise-free reading explains half of the prior variance."""


AnyOptions = TypeVar("AnyOptions", bound=Options)
AnyGPOptions = TypeVar("AnyGPOptions", bound=GPOptions)


@dataclass(frozen=True)
class TrainingOrigin:
    """Where a trained process came from.

    Attributes
    ----------
    readings
        Number of readings before thinning.
    learning
        How learning ended; absent where the hyperparameters were given.
    """

    readings: int
    learning: LikelihoodFit | None


ORIGIN = TypeAdapter(TrainingOrigin)


@dataclass(frozen=True)
class Trained:
    """A training set and the hyperparameters to condition it with."""

    readings: TrainingSet
    hyperparameters: KernelHyperparameters
    origin: TrainingOrigin

    @property
    def noise_variance(self) -> FloatArray:
        """Variance of the noise of each row in square microtesla, shape (N,)."""
        return self.hyperparameters.noise**2 / self.readings.weight


@dataclass(frozen=True)
class GPMap(ABC, Generic[AnyGPOptions]):
    """What the Gaussian-process maps have in common: all but how they are conditioned and asked.

    Attributes
    ----------
    kind
        Name of the map kind.
    model
        Class of its options.
    trained
        Training readings in the map frame and hyperparameters.
    options
        Effective options.
    mean
        Prior mean in uT, shape (3,).
    frame
        Name of the map frame; None where it is not known.
    """

    kind: ClassVar[str]
    model: ClassVar[Any]
    trained: Trained
    options: AnyGPOptions
    mean: FloatArray
    _: KW_ONLY
    frame: str | None = None

    @classmethod
    def fit(
        cls, points: FloatArray, field: FloatArray, options: AnyGPOptions | None = None
    ) -> Self:
        """Return the map of readings in the map frame, shapes (N, 3) in metres and (N, 3) in uT.

        Raises
        ------
        MapError
            If the readings are not fit for a map of this kind.
        """
        options = cls.model() if options is None else options
        return cls.condition(train(points, field, options), options)

    @classmethod
    @abstractmethod
    def condition(cls, trained: Trained, options: AnyGPOptions) -> Self:
        """Return the map of training readings whose hyperparameters are known.

        Raises
        ------
        MapError
            If there are too many readings, or their covariance is not positive definite.
        """

    @classmethod
    def from_state(cls, state: MapState) -> Self:
        """Return the map that ``to_state`` took apart.

        Raises
        ------
        MapError
            If the state is damaged.
        """
        options = options_from_state(state, cls.model)
        return cls.condition(trained_from_state(state), options)

    @property
    def readings(self) -> TrainingSet:
        """Training readings in the map frame, thinned."""
        return self.trained.readings

    @property
    def facts(self) -> dict[str, Any]:
        """What a kind adds to its summary."""
        return {}

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""
        points, known = self.readings.points, self.trained.hyperparameters
        learning = self.trained.origin.learning
        return MapSummary(
            kind=self.kind,
            readings=self.trained.origin.readings,
            rows=len(points),
            lower=points.min(axis=0),
            upper=points.max(axis=0),
            facts={
                "length scale (m)": known.length_scale,
                "signal (uT)": known.signal,
                "noise of a reading (uT)": known.noise,
                "hyperparameters": _described(learning),
                **self.facts,
            },
        )

    def updated(self, points: FloatArray, field: FloatArray, /) -> Self:
        """Return the map with more readings and the same hyperparameters; see ``FieldMap``."""
        known = extended(self.trained, points, field, self.options)
        return self.condition(known, self.options).in_frame(self.frame)

    def in_frame(self, frame: str | None, /) -> Self:
        """Return the map with another name of its frame."""
        return replace(self, frame=frame)

    def to_state(self) -> MapState:
        """Return the map as plain arrays and facts."""
        return trained_to_state(self.kind, self.trained, self.options)


def train(points: FloatArray, field: FloatArray, options: GPOptions) -> Trained:
    """Return readings with hyperparameters, thinned.

    Parameters
    ----------
    points
        Positions in the map frame in metres, shape (N, 3).
    field
        Readings in the map frame in microtesla, shape (N, 3).
    options
        Options of the map, lengths in length scales.

    Raises
    ------
    MapError
        If no map can be made of the readings.
    """
    readings = training_set(points, field)
    learning = None
    hyperparameters = options.hyperparameters
    if hyperparameters is None:
        learning = learn(readings, options.learning, options.thinning)
        hyperparameters = learning.hyperparameters
    kept = thinned(readings, hyperparameters.length_scale, options.thinning)
    return Trained(kept, hyperparameters, TrainingOrigin(len(readings), learning))


def extended(
    trained: Trained, points: FloatArray, field: FloatArray, options: GPOptions
) -> Trained:
    """Return the same hyperparameters with more readings, thinned together with the old ones.

    Where a cube held more readings than count as independent, new ones in it weigh as much as
    those that counted: the others are forgotten.

    Parameters
    ----------
    trained
        Training readings and hyperparameters of the map so far.
    points
        Positions of the new readings in the map frame in metres, shape (N, 3).
    field
        New readings in the map frame in microtesla, shape (N, 3).
    options
        Options of the map, lengths in length scales.

    Raises
    ------
    MapError
        If the readings are not fit for a map.
    """
    new = additional_set(points, field)
    together = joined(trained.readings, new)
    kept = thinned(together, trained.hyperparameters.length_scale, options.thinning)
    origin = replace(trained.origin, readings=trained.origin.readings + len(new))
    return replace(trained, readings=kept, origin=origin)


def trained_to_state(kind: str, trained: Trained, options: GPOptions) -> MapState:
    """Return a map as its training rows: factors are cheaper to compute again than to store."""
    values = trained.hyperparameters.model_dump()
    arrays: dict[str, npt.NDArray[Any]] = {
        "points": trained.readings.points,
        "field": trained.readings.field,
        "weight": trained.readings.weight,
        "hyperparameters": np.array([values[name] for name in NAMES]),
    }
    origin = ORIGIN.dump_python(trained.origin, mode="json")
    return MapState(kind, arrays, options.model_dump(mode="json"), origin)


def trained_from_state(state: MapState) -> Trained:
    """Return what ``trained_to_state`` took apart; the state may come from an untrusted file.

    Raises
    ------
    MapError
        If an array or an entry is missing, of the wrong shape, or makes no sense.
    """
    values = state_array(state, "hyperparameters")
    if values.shape != (len(NAMES),):
        raise MapError(f"map array hyperparameters has shape {values.shape}; (3,) is needed")
    try:
        hyperparameters = KernelHyperparameters(**dict(zip(NAMES, values.tolist(), strict=True)))
        origin = ORIGIN.validate_python(state.provenance)
    except ValidationError as error:
        raise MapError(f"map state is damaged: {first_complaint(error)}") from None
    arrays = (state_array(state, name) for name in ("points", "field", "weight"))
    return Trained(training_set(*arrays), hyperparameters, origin)


def options_from_state(state: MapState, model: type[AnyOptions]) -> AnyOptions:
    """Return the options of a state.

    Raises
    ------
    MapError
        If they are not options of this kind.
    """
    try:
        return model.model_validate(state.options)
    except ValidationError as error:
        raise MapError(f"map options are damaged: {first_complaint(error)}") from None


def state_array(state: MapState, name: str) -> FloatArray:
    """Return a numeric array of a state as float64.

    Raises
    ------
    MapError
        If it is missing or not numeric.
    """
    array = state.arrays.get(name)
    if array is None or array.dtype.kind not in "fiu":
        raise MapError(f"map state of kind {state.kind} needs a numeric array {name}")
    return np.asarray(array, dtype=np.float64)


def first_complaint(error: ValidationError) -> str:
    """Return the first complaint of pydantic as one line."""
    detail = error.errors()[0]
    where = ".".join(str(part) for part in detail["loc"])
    what = detail["msg"].removeprefix("Value error, ")
    return f"{where}: {what}" if where else what


def _described(learning: LikelihoodFit | None) -> str:
    if learning is None:
        return "given"
    return learning_words(learning.converged, learning.at_bound, learning.message)


def learning_words(converged: bool, at_bound: tuple[str, ...], message: str = "") -> str:
    """Return how learning ended, in a few words and those of the optimiser."""
    if at_bound:
        return f"learnt, not determined by the data: {', '.join(at_bound)}"
    return "learnt" if converged else f"learnt, search stopped early{message and f': {message}'}"
