"""The frame that a map is in: drives on it have poses in the same one, or are refused."""

from typing import Protocol, Self, TypeVar, runtime_checkable

from l2m_gtsam.data import ARRAYS, Recording
from l2m_gtsam.errors import MapError

AnyMap = TypeVar("AnyMap")


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
