"""What the application asks of a map, whatever its kind; and the frame that it is in."""

from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

import numpy as np

from l2m_gtsam.data import ARRAYS, FieldAndGradient, FieldSample, FloatArray, MapState, Recording
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.records.map_diary import MapDiary

AnyMap = TypeVar("AnyMap")


@dataclass(frozen=True)
class MapSummary:
    """What `l2m map info` prints.

    Attributes
    ----------
    kind
        Name of the map kind.
    readings
        Readings that the map was given.
    rows
        Rows that it kept of them after thinning.
    lower, upper
        Corners of the box around them in the map frame in metres, shape (3,).
    facts
        What else is worth knowing of this kind, by name with unit: plain values.
    doubts
        What speaks against trusting the map, a sentence each.
    """

    kind: str
    readings: int
    rows: int
    lower: FloatArray
    upper: FloatArray
    facts: dict[str, Any]
    doubts: tuple[str, ...] = ()


# What some maps have and others have not, by which protocols know them.
OPTIONAL = (
    "errors_over",
    "tile_of",
    "weights_in",
    "sensors_uncertain",
    "poses_uncertain",
    "errors_over_stated",
    "compile",
    "summary",
    "readings",
    "diary",
)


class WrappedMap:
    """A map with something beside it; in all that a derived class has not, the map itself.

    ``isinstance`` with a protocol looks for members that are there, since Python 3.12 without
    asking ``__getattr__``: a wrapper has to have what its map has.

    Parameters
    ----------
    field_map
        The map.
    """

    def __init__(self, field_map: object) -> None:
        self._map: Any = field_map
        for name in OPTIONAL:
            if hasattr(field_map, name) and not hasattr(type(self), name):
                vars(self)[name] = getattr(field_map, name)

    def __getattr__(self, name: str) -> Any:
        if name == "_map":  # before there is one, as when another process unpacks it
            raise AttributeError(name)
        return getattr(self._map, name)


@runtime_checkable
class Summarised(Protocol):
    """A map that can summarise its quality."""

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""


@runtime_checkable
class Surveyed(Protocol):
    """A map that still knows what it was made of."""

    @property
    def readings(self) -> TrainingSet:
        """Readings in the map frame, thinned or averaged."""


@runtime_checkable
class Remembering(Protocol):
    """A map that may know what it went through since its survey."""

    @property
    def diary(self) -> MapDiary | None:
        """Drives and what changed between them; None where it was not kept up."""


class FieldMap(Protocol):
    """A magnetic field learnt from readings, in the map frame."""

    @property
    def kind(self) -> str:
        """Name of the map kind, as in the registry of ``build``."""

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance at points, shape (N, 3), in metres.

        Points without data nearby are not ``inside``: NaN, with infinite variance.

        Raises
        ------
        MapError
            If a point is not finite or the shape is wrong.
        """

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m, also outside of the map.

        Never NaN: away from data the field returns to its mean, so that an optimiser may leave
        the map in a trial step. ``gradient[n, i, j]`` = dB_i/dx_j. A harmonic map is constant
        beyond the walls of its tiles, and keeps the gradient of the wall there, which leads back.

        Raises
        ------
        MapError
            If a point is not finite or the shape is wrong.
        """

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the posterior variance per axis in uT^2, shape (N, 3), also outside of the map.

        Raises
        ------
        MapError
            If a point is not finite or the shape is wrong.
        """

    def updated(self, points: FloatArray, field: FloatArray, /) -> "FieldMap":
        """Return the map with more readings, shapes (N, 3) in metres and uT, and the same prior.

        The prior is that of the whole map: a kind may let its parts follow the new readings.

        Raises
        ------
        MapError
            If the readings are not fit for a map.
        """

    def to_state(self) -> MapState:
        """Return the map as plain arrays and facts."""


def unknown(count: int) -> FieldSample:
    """Return the sample of so many points without data nearby."""
    return FieldSample(
        np.full((count, 3), np.nan),
        np.full((count, 3, 3), np.nan),
        np.full((count, 3), np.inf),
        np.zeros(count, dtype=np.bool_),
    )


def masked(sample: FieldSample) -> FieldSample:
    """Return a sample with no values where the map has no data: NaN and infinite variance."""
    inside = sample.inside
    return FieldSample(
        np.where(inside[:, None], sample.field, np.nan),
        np.where(inside[:, None, None], sample.gradient, np.nan),
        np.where(inside[:, None], sample.variance, np.inf),
        inside,
    )


@runtime_checkable
class Framed(Protocol):
    """A map that may know the name of its frame."""

    @property
    def frame(self) -> str | None:
        """Name of the frame; None where it is not known."""

    def in_frame(self, frame: str | None, /) -> Self:
        """Return the map with another name of its frame."""


def framed(field_map: AnyMap, frame: object) -> AnyMap:
    """Return a map with the name of its frame; as it is if there is no name, or it keeps none."""
    if isinstance(frame, str) and isinstance(field_map, Framed):
        return field_map.in_frame(frame)
    return field_map


def frame_of(field_map: object) -> str | None:
    """Return the name of a map's frame; None where it is not known."""
    return field_map.frame if isinstance(field_map, Framed) else None


def check_frame(field_map: object, recording: Recording, place: str = "the map") -> None:
    """Raise a MapError for drives that are said to be in another frame than a map.

    Parameters
    ----------
    field_map
        A map of any kind; one without the name of a frame suits every drive.
    recording
        One drive or several.
    place
        What the map is called.
    """
    for drive in recording.parts:
        refuse_other_frame(frame_of(field_map), drive, place)


def refuse_other_frame(frame: object, drive: Recording, place: str) -> None:
    """Raise a MapError for a drive that is said to be in another frame than that of a map."""
    own = drive.trajectory.frame
    if frame in (None, own):
        return
    by_arrays = drive.source.path == ARRAYS
    same = f"`frame={frame!r}` of `l2m_gtsam.drive`" if by_arrays else f"`bag.frame: {frame}`"
    raise MapError(
        f"{place} is in frame {frame!r}, the poses of {drive.source.path} are in {own!r}; if both "
        f"mean the same, say so with {same}"
    )
