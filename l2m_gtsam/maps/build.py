"""The kinds of maps: one entry each, from readings and from a stored state."""

from collections.abc import Callable
from dataclasses import dataclass

from pydantic import field_validator

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.dense_gp import DenseGP, DenseGPOptions
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.sliding_gp import SlidingGP, SlidingGPOptions
from l2m_gtsam.options import Options


class MapOptions(Options):
    """Which kind of map to build, and the options of each kind."""

    kind: str = "sliding_gp"
    """Name of the kind: sliding_gp (the paper's), or dense_gp (slow, for small maps)."""

    sliding_gp: SlidingGPOptions = SlidingGPOptions()
    """Used where the kind is sliding_gp."""

    dense_gp: DenseGPOptions = DenseGPOptions()
    """Used where the kind is dense_gp."""

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in KINDS:
            raise ValueError(f"map kind {kind!r} is not known; {', '.join(KINDS)} are")
        return kind


@dataclass(frozen=True)
class MapKind:
    """How a map of one kind comes about.

    Attributes
    ----------
    fit
        From positions and readings in the map frame, (N, 3) each, in metres and microtesla.
    load
        From a stored state.
    """

    fit: Callable[[FloatArray, FloatArray, MapOptions], FieldMap]
    load: Callable[[MapState], FieldMap]


KINDS = {
    "sliding_gp": MapKind(lambda p, b, o: SlidingGP.fit(p, b, o.sliding_gp), SlidingGP.from_state),
    "dense_gp": MapKind(lambda p, b, o: DenseGP.fit(p, b, o.dense_gp), DenseGP.from_state),
}
"""Every kind of map. A new kind is its own file, its line here and its options above."""


def build_map(points: FloatArray, field: FloatArray, options: MapOptions | None = None) -> FieldMap:
    """Return a map of readings.

    Parameters
    ----------
    points
        Positions of the readings in the map frame in metres, shape (N, 3).
    field
        Readings in the map frame in microtesla, shape (N, 3).
    options
        Defaults where absent.

    Raises
    ------
    MapError
        If no map can be made of the readings.
    """
    options = MapOptions() if options is None else options
    return KINDS[options.kind].fit(points, field, options)


def map_from_state(state: MapState) -> FieldMap:
    """Return the map that a state holds.

    Raises
    ------
    MapError
        If the kind is not known or the state is damaged.
    """
    if state.kind not in KINDS:
        raise MapError(f"map kind {state.kind!r} is not known; {', '.join(KINDS)} are")
    return KINDS[state.kind].load(state)
