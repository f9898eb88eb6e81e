"""The kinds of maps: one entry each, from readings and from a stored state."""

from collections.abc import Callable
from dataclasses import dataclass

from pydantic import field_validator

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.bilinear.bilinear_map import BilinearMap
from l2m_gtsam.maps.bilinear.lattice import BilinearOptions
from l2m_gtsam.maps.dense_gp import DenseGP, DenseGPOptions
from l2m_gtsam.maps.field_map import FieldMap, framed
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.sliding_gp import SlidingGP, SlidingGPOptions
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.options import Options


class MapOptions(Options):
    """Which kind of map to build, and the options of each kind."""

    kind: str = "harmonic"
    """Name of the kind: harmonic (obeys Maxwell's equations), sliding_gp (the paper's), bilinear
    (the paper's baseline), or dense_gp (slow, for small maps)."""

    harmonic: HarmonicOptions = HarmonicOptions()
    """Used where the kind is harmonic."""

    sliding_gp: SlidingGPOptions = SlidingGPOptions()
    """Used where the kind is sliding_gp."""

    bilinear: BilinearOptions = BilinearOptions()
    """Used where the kind is bilinear."""

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
        From positions and readings in the map frame, (N, 3) each, in metres and microtesla, and
        options of the kind; where it uses them as well from the LiDAR's structure cloud, in metres,
        (M, 3), and what errors of sensors and poses do to the readings, each if there is one.
    load
        From a stored state.
    uses_structure
        Whether the kind has a use for a structure cloud, and for such errors.
    """

    fit: Callable[..., FieldMap]
    load: Callable[[MapState], FieldMap]
    uses_structure: bool = False


KINDS = {
    "harmonic": MapKind(HarmonicMap.fit, HarmonicMap.from_state, uses_structure=True),
    "sliding_gp": MapKind(SlidingGP.fit, SlidingGP.from_state),
    "bilinear": MapKind(BilinearMap.fit, BilinearMap.from_state),
    "dense_gp": MapKind(DenseGP.fit, DenseGP.from_state),
}
"""Every kind of map. A new kind is its own file, its line here, its options above by its name."""


def refuse_structure(*kinds: str) -> None:
    """Raise a MapError if no map of these kinds has a use for a structure cloud."""
    if any(KINDS[kind].uses_structure for kind in kinds):
        return
    useful = " or ".join(name for name, kind in KINDS.items() if kind.uses_structure)
    raise MapError(
        f"maps of kind {', '.join(kinds)} cannot use a structure cloud; leave it out or choose "
        f"the kind {useful}"
    )


def build_map(
    points: FloatArray,
    field: FloatArray,
    options: MapOptions | None = None,
    cloud: FloatArray | None = None,
    suite: SuiteErrors | None = None,
    poses: SurveyPoses | None = None,
) -> FieldMap:
    """Return a map of readings.

    Parameters
    ----------
    points
        Positions of the readings in the map frame in metres, shape (N, 3).
    field
        Readings in the map frame in microtesla, shape (N, 3).
    options
        Defaults where absent.
    cloud
        Structure that a LiDAR saw: points of the map frame in metres, shape (M, 3).
    suite
        What errors of the sensors do to the readings; absent where they count as exact.
    poses
        The same for the errors of the poses.

    Raises
    ------
    MapError
        If no map can be made of the readings, or the kind has no use for a structure cloud.
    """
    options = MapOptions() if options is None else options
    if cloud is not None:
        refuse_structure(options.kind)
    kind, own = KINDS[options.kind], getattr(options, options.kind)
    survey = (cloud, suite, poses) if kind.uses_structure else ()
    return kind.fit(points, field, own, *survey)


def map_from_state(state: MapState) -> FieldMap:
    """Return the map that a state holds.

    Raises
    ------
    MapError
        If the kind is not known or the state is damaged.
    """
    if state.kind not in KINDS:
        raise MapError(f"map kind {state.kind!r} is not known; {', '.join(KINDS)} are")
    return framed(KINDS[state.kind].load(state), state.provenance.get("frame"))
