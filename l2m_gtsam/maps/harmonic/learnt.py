"""What a harmonic map knows before any tile is solved: readings, prior, sources, tiling."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, TypeAdapter, ValidationError

from l2m_gtsam.data import FloatArray, IntArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.grid import grid_from
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.error_options import ErrorOptions
from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.explanation import (
    UNJUDGED,
    Explanation,
    explanation_of,
    patchwork,
)
from l2m_gtsam.maps.harmonic.furnish import COARSE, FINE, basis_of, within
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.learning import LearningEnd, LearningOptions, learn, spread_tiles
from l2m_gtsam.maps.harmonic.search import (
    MOST_READINGS,
    SearchOptions,
    look_for_sources,
    residuals_of,
)
from l2m_gtsam.maps.harmonic.strengths import learn_strengths
from l2m_gtsam.maps.harmonic.structure import MOST_SOURCES, Sources, StructureOptions
from l2m_gtsam.maps.harmonic.threads import in_threads
from l2m_gtsam.maps.harmonic.tiling import (
    Resolution,
    Tiling,
    TilingOptions,
    affordable,
    blend_of,
    resolution_of,
    surveyed_area,
    tiling_of,
)
from l2m_gtsam.maps.trained import first_complaint, options_from_state, state_array
from l2m_gtsam.maps.training import FEWEST, TrainingSet, joined, merged, training_set
from l2m_gtsam.options import Options

SAFE = 1.5  # times the modes that a tile of a file may have
KNOWN = 0.5  # of the readings' variance: a map that says less might as well say their mean
JUDGED = 4  # tiles whose held-out places say whether the field is explained
GROWTH = 1.5  # of the sources, after which the prior is learnt anew


class HarmonicOptions(Options):
    """Options of the harmonic map; lengths in metres."""

    hyperparameters: Hyperparameters | None = None
    """Fixed hyperparameters; learnt from the marginal likelihood where absent."""
    learning: LearningOptions = LearningOptions()
    """The windows they are learnt from; one set serves the whole map."""
    structure: StructureOptions = StructureOptions()
    """How a LiDAR's point cloud becomes sources."""
    search: SearchOptions = SearchOptions()
    """The search for sources where there is no point cloud."""
    tiling: TilingOptions = TilingOptions()
    """The surroundings of a tile."""
    errors: ErrorOptions = ErrorOptions()
    """How finely the map's error over a drive is told."""
    sensor_noise: float | None = Field(default=None, gt=0)
    """Standard deviation of the survey's sensors per axis in uT, from the data sheet, to judge
    the learnt noise by; not used otherwise."""
    merge: float = Field(default=0.05, gt=0)
    """Readings within cubes of this edge are averaged."""
    independent: int = Field(default=50, ge=1)
    """The most that the readings of one cube are worth: their errors share the pose and the
    disturbances of one passage."""
    modes: int = Field(default=1000, ge=50)
    """About how many modes a tile has; tiles are as large as that allows."""
    mode_share: float = Field(default=0.05, gt=0, lt=1)
    """A mode is kept if the readings could reduce its prior variance by this share; what is left
    out counts as variance."""
    reach: float = Field(default=0.5, gt=0)
    """A point is inside the map when a reading is this near and the field is known to better than
    half of the variance with which the readings vary."""


@dataclass(frozen=True)
class Origin:
    """Where the map came from.

    Attributes
    ----------
    readings
        Readings before they were merged.
    learning
        How learning ended.
    searched
        Whether the sources were searched for in the residuals, for want of a point cloud.
    explanation
        How well the map predicts places that are held out.
    """

    readings: int
    learning: LearningEnd
    searched: bool = False
    explanation: Explanation = UNJUDGED


ORIGIN = TypeAdapter(Origin)


@dataclass(frozen=True)
class Learnt:
    """Everything that the tiles follow from.

    Attributes
    ----------
    readings
        Training readings, merged.
    hyperparameters
        Of the prior, shared by all tiles.
    sources
        Candidate sources.
    strengths
        Of each structure among them; 0 where the readings show none.
    tiling
        Where the tiles lie.
    resolution
        Largest wave numbers of the modes.
    origin
        For the record.
    """

    readings: TrainingSet
    hyperparameters: Hyperparameters
    sources: Sources
    strengths: FloatArray
    tiling: Tiling
    resolution: Resolution
    origin: Origin

    @cached_property
    def members(self) -> list[IntArray]:
        """Rows of the readings that take part in each tile."""
        return self.tiling.grid.members(self.readings.points, self.tiling.overlap)

    @property
    def most_variance(self) -> float:
        """Variance of the three axes together beyond which the field is not known, uT^2."""
        varied = float(self.readings.field.var(axis=0).sum())
        return max(KNOWN * varied, 3 * self.hyperparameters.noise**2)

    def basis(self, tile: int, rows: IntArray, visible: float = FINE) -> Basis:
        """Return the basis of a tile for its readings; ``visible`` is that of ``dipoles_of``."""
        centre, edge = self.tiling.grid.centres[tile], self.tiling.edge
        near = within(self.sources, centre, edge)
        split = self.sources.split()
        return basis_of(
            self.readings[rows],
            centre,
            edge,
            self.resolution,
            [split[s] for s in near],
            self.strengths[near],
            visible,
        )

    def extended(self, new: TrainingSet, options: HarmonicOptions) -> "Learnt":
        """Return the same prior and tiles, with more readings and the tiles that they need."""
        readings = merged(joined(self.readings, new), options.merge, options.independent)
        grid = self.tiling.grid
        reach = reach_of(grid.size, options)
        wider = grid_from(grid.origin, readings.points, grid.size, reach)
        return replace(
            self,
            readings=readings,
            tiling=replace(self.tiling, grid=wider),
            origin=replace(self.origin, readings=self.origin.readings + len(new)),
        )


def learn_map(raw: TrainingSet, sources: Sources, options: HarmonicOptions) -> Learnt:
    """Return what readings and sources teach.

    Parameters
    ----------
    raw
        Readings in the map frame as they were taken.
    sources
        Where steel can be.
    options
        Of the map.

    Raises
    ------
    MapError
        If no map can be made of the readings.
    """
    readings = merged(raw, options.merge, options.independent)
    if len(readings) < FEWEST:
        raise MapError(
            f"the {len(raw)} map training readings lie at {len(readings)} places "
            f"{options.merge:g} m apart; at least {FEWEST} are needed"
        )
    learnt = learn_once(readings, sources, options)
    if not len(sources) and learnt.origin.explanation.reasons and options.search.rounds > 0:
        learnt = with_search(learnt, options)
    return replace(learnt, origin=replace(learnt.origin, readings=len(raw)))


def learn_once(readings: TrainingSet, sources: Sources, options: HarmonicOptions) -> Learnt:
    """Return what readings teach over given sources, and how well that explains them."""
    learning = learn_prior(readings, sources, options)
    plain = laid_out(readings, learning, sources, np.ones(len(sources.split())), options)
    return explained(with_strengths(plain), options)


def explained(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same with a verdict from a few of its tiles."""
    members = learnt.members
    works = []
    for tile in spread_tiles(learnt.tiling, [len(rows) for rows in members], JUDGED):
        rows = evenly(members[tile], options.learning.readings)
        basis = learnt.basis(tile, rows, COARSE)
        works.append(patchwork(basis, learnt.readings[rows], options.learning.seed))
    explanation = explanation_of(works, learnt.hyperparameters, options.sensor_noise)
    return replace(learnt, origin=replace(learnt.origin, explanation=explanation))


def evenly(rows: IntArray, most: int) -> IntArray:
    """Return at most so many of the rows, spread evenly."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]


def learn_prior(readings: TrainingSet, sources: Sources, options: HarmonicOptions) -> LearningEnd:
    """Return the hyperparameters that are given, or else those that the readings teach."""
    if options.hyperparameters is not None:
        return LearningEnd(options.hyperparameters, None, 0, converged=True, at_bound=())
    return learn(readings, sources, options.tiling, options.mode_share, options.learning)


def with_search(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same with sources found round by round in the residuals.

    What is not explained yet counts as noise and hides weaker sources: the prior is learnt anew
    whenever the sources have become half as many again, and when no more are found.
    """
    readings, current, learnt_with = learnt.readings, learnt, 0
    for _ in range(options.search.rounds):
        found = found_in_tiles(current, options)
        if not len(found) and len(current.sources) == learnt_with:
            break
        positions = np.concatenate([current.sources.positions, found])
        sources = Sources(positions, np.arange(len(positions)))
        learning = current.origin.learning
        if not len(found) or len(positions) >= GROWTH * learnt_with:
            learning, learnt_with = learn_prior(readings, sources, options), len(positions)
        current = laid_out(readings, learning, sources, np.ones(len(positions)), options)
    searched = replace(current.origin, searched=True)
    return explained(with_strengths(replace(current, origin=searched)), options)


def found_in_tiles(plain: Learnt, options: HarmonicOptions) -> FloatArray:
    """Return the places of one round of the search over all tiles, shape (K, 3)."""
    members = plain.members

    def look(tile: int) -> FloatArray:
        rows = evenly(members[tile], MOST_READINGS)
        basis, readings = plain.basis(tile, rows, COARSE), plain.readings[rows]
        residuals = residuals_of(basis, readings, plain.hyperparameters)
        found = look_for_sources(residuals, options.search)
        return np.array([each.position for each in found]).reshape(-1, 3)

    tiles = list(range(len(plain.tiling)))
    places = in_threads(look, tiles)
    own = [
        place[plain.tiling.grid.block_of(place) == tile]
        for tile, place in zip(tiles, places, strict=True)
        if len(place)
    ]
    return np.concatenate([np.empty((0, 3)), *own])


def laid_out(
    readings: TrainingSet,
    learning: LearningEnd,
    sources: Sources,
    strengths: FloatArray,
    options: HarmonicOptions,
) -> Learnt:
    """Return readings and prior with the tiles that suit them."""
    density = float(readings.weight.sum()) / surveyed_area(readings.points)
    finest = resolution_of(learning.hyperparameters, density, options.mode_share)
    resolution = affordable(finest, options.tiling, options.modes)
    tiling = tiling_of(readings.points, resolution, options.tiling, options.modes, options.reach)
    origin = Origin(len(readings), learning)
    return Learnt(
        readings, learning.hyperparameters, sources, strengths, tiling, resolution, origin
    )


def with_strengths(plain: Learnt) -> Learnt:
    """Return the same with the strength of every structure, learnt in the tile it stands in."""
    middles = structure_middles(plain.sources)
    if not len(middles):
        return plain
    home, members = plain.tiling.grid.block_of(middles), plain.members

    def found(tile: int) -> dict[int, float]:
        basis = plain.basis(tile, members[tile], COARSE)
        normal = normal_of(basis, plain.readings[members[tile]])
        near = within(plain.sources, plain.tiling.grid.centres[tile], plain.tiling.edge)
        strengths = learn_strengths(basis, normal, plain.hyperparameters)
        return dict(zip(near, strengths, strict=True))

    strengths = plain.strengths.copy()
    tiles = np.unique(home).tolist()
    for tile, each in zip(tiles, in_threads(found, tiles), strict=True):
        for structure, strength in each.items():
            if home[structure] == tile:
                strengths[structure] = strength
    return replace(plain, strengths=strengths)


def structure_middles(sources: Sources) -> FloatArray:
    """Return the middle of each structure in metres, shape (S, 3)."""
    return np.array([each.positions.mean(axis=0) for each in sources.split()]).reshape(-1, 3)


def learnt_to_state(kind: str, learnt: Learnt, options: HarmonicOptions) -> MapState:
    """Return a map as what its tiles follow from: far smaller than their covariances."""
    values = learnt.hyperparameters.model_dump()
    arrays: dict[str, npt.NDArray[Any]] = {
        "points": learnt.readings.points,
        "field": learnt.readings.field,
        "weight": learnt.readings.weight,
        "hyperparameters": np.array([values[name] for name in sorted(values)]),
        "sources": learnt.sources.positions,
        "structure": learnt.sources.structure,
        "strengths": learnt.strengths,
        "tiling": np.array([*learnt.tiling.grid.origin, learnt.tiling.grid.size]),
        "resolution": np.array([learnt.resolution.floor, learnt.resolution.ceiling]),
    }
    origin = ORIGIN.dump_python(learnt.origin, mode="json")
    return MapState(kind, arrays, options.model_dump(mode="json"), origin)


def learnt_from_state(state: MapState) -> tuple[Learnt, HarmonicOptions]:
    """Return what ``learnt_to_state`` took apart; the state may come from an untrusted file.

    Raises
    ------
    MapError
        If an array or an entry is missing, of the wrong shape, or makes no sense.
    """
    options = options_from_state(state, HarmonicOptions)
    try:
        values = dict(
            zip(
                sorted(Hyperparameters.model_fields),
                state_array(state, "hyperparameters").tolist(),
                strict=True,
            )
        )
        hyperparameters = Hyperparameters(**values)
        origin = ORIGIN.validate_python(state.provenance)
    except ValidationError as error:
        raise MapError(f"map state is damaged: {first_complaint(error)}") from None
    except (TypeError, ValueError):
        raise MapError("map array hyperparameters is not of the shape that is needed") from None
    readings = training_set(*(state_array(state, name) for name in ("points", "field", "weight")))
    sources, strengths = sources_from_state(state)
    tiling, resolution = tiles_from_state(state, readings, options)
    learnt = Learnt(readings, hyperparameters, sources, strengths, tiling, resolution, origin)
    return learnt, options


def tiles_from_state(
    state: MapState, readings: TrainingSet, options: HarmonicOptions
) -> tuple[Tiling, Resolution]:
    """Return how the tiles of a state lie and what they resolve, after checks."""
    place, waves = state_array(state, "tiling"), state_array(state, "resolution")
    if place.shape != (3,) or waves.shape != (2,) or not np.isfinite([*place, *waves]).all():
        raise MapError("map tiling is damaged: three finite numbers and two are needed")
    size, surroundings = float(place[2]), options.tiling
    resolution = Resolution(float(waves[0]), float(waves[1]))
    edge = size + 2 * (surroundings.overlap + surroundings.margin)
    if min(size, *waves) <= 0 or resolution.modes(edge) > SAFE * options.modes:
        raise MapError("map tiling is damaged: tiles and waves do not fit the number of modes")
    grid = grid_from(place[:2], readings.points, size, reach_of(size, options))
    blend = blend_of(size, surroundings)
    return Tiling(grid, surroundings.overlap, surroundings.margin, blend), resolution


def reach_of(core: float, options: HarmonicOptions) -> float:
    """Return how far from the readings tiles lie, metres: each has readings in its overlap."""
    return min(options.reach, options.tiling.overlap, 0.49 * core)


def sources_from_state(state: MapState) -> tuple[Sources, FloatArray]:
    """Return the sources of a state and the strengths of their structures, after checks."""
    positions, number, strengths = (
        state_array(state, name) for name in ("sources", "structure", "strengths")
    )
    flat = number.ndim == strengths.ndim == 1 and np.isfinite(number).all()
    if not flat or positions.shape != (number.size, 3) or number.size > MOST_SOURCES:
        raise MapError("map sources are damaged: their arrays do not have the shapes needed")
    structure = number.astype(np.int64)
    fits = np.isfinite(positions).all() and bool((structure >= 0).all())
    numbered = np.array_equal(np.unique(structure), np.arange(len(strengths)))
    if not (fits and numbered and np.isfinite(strengths).all() and (strengths >= 0).all()):
        raise MapError("map sources are damaged: positions, structures and strengths disagree")
    return Sources(positions, structure), strengths
