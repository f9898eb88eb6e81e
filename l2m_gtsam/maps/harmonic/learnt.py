"""What a harmonic map knows before any tile is solved: readings, prior, sources, tiling."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import Field, TypeAdapter

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.grid import grid_from
from l2m_gtsam.maps.harmonic.basis import FINE, Basis, basis_of
from l2m_gtsam.maps.harmonic.explanation import UNJUDGED, Explanation
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import TileFrame, tile_frame
from l2m_gtsam.maps.harmonic.history import History
from l2m_gtsam.maps.harmonic.learning import LearningEnd, LearningOptions
from l2m_gtsam.maps.harmonic.local import LocalOptions
from l2m_gtsam.maps.harmonic.search import SearchOptions
from l2m_gtsam.maps.harmonic.structure import Sources, StructureOptions
from l2m_gtsam.maps.harmonic.tiling import (
    Resolution,
    Tiling,
    TilingOptions,
    affordable,
    finest,
    resolution_of,
    surveyed_area,
    tiling_of,
)
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.maps.training import (
    TrainingSet,
    cubes_of,
    errors_together,
    joined,
    merged,
    survey_doubts,
)
from l2m_gtsam.options import Options
from l2m_gtsam.records.map_diary import UNDATED, MapDrive

KNOWN = 0.5  # of the readings' variance: a map that explains less is no better than their mean


class ErrorOptions(Options):
    """How finely the map's error is resolved."""

    places: int = Field(default=100, ge=10)
    """The most places of a tile that its modes are chosen at, spread over the drive."""
    rest: float = Field(default=0.02, gt=0, lt=1)
    """Share of the map's variance at these places that may stay without correlation."""


class HarmonicOptions(Options):
    """Options of the harmonic map; lengths in metres."""

    hyperparameters: Hyperparameters | None = None
    """Fixed hyperparameters of all tiles; learnt from the marginal likelihood where absent."""
    learning: LearningOptions = LearningOptions()
    """The windows that those of the whole map are learnt from."""
    local: LocalOptions = LocalOptions()
    """How far those of a tile may differ from them."""
    structure: StructureOptions = StructureOptions()
    """How a LiDAR's point cloud becomes sources."""
    search: SearchOptions = SearchOptions()
    """The search for sources where there is no point cloud."""
    tiling: TilingOptions = TilingOptions()
    """The surroundings of a tile."""
    errors: ErrorOptions = ErrorOptions()
    """How finely the map's error over a drive is resolved."""
    sensor_noise: float | None = Field(default=None, gt=0)
    """Standard deviation of the survey's sensors per axis in uT, from the data sheet, to judge
    the learnt noise by; not used otherwise."""
    merge: float = Field(default=0.05, gt=0)
    """Readings within cubes of this edge are averaged."""
    independent: int = Field(default=50, ge=1)
    """The most that the readings of one cube are worth: their errors share the pose and the
    disturbances of one passage."""
    modes: int = Field(default=400, ge=50)
    """About how many modes a tile has; tiles are as large as that allows."""
    mode_share: float = Field(default=0.05, gt=0, lt=1)
    """A mode is kept if the readings could reduce its prior variance by this share; what is left
    out counts as variance."""
    reach: float = Field(default=0.5, gt=0)
    """A point is inside the map when a reading is this near and the field is known to better than
    half of the variance with which the readings vary."""

    @property
    def effective_local(self) -> LocalOptions:
        """Fixed hyperparameters are those of every tile."""
        return self.local if self.hyperparameters is None else LocalOptions(spread=0)


@dataclass(frozen=True)
class Origin:
    """Where the map came from.

    Attributes
    ----------
    readings
        Number of readings before they were merged.
    learning
        How learning ended.
    searched
        Whether the sources were searched for in the residuals, for want of a point cloud.
    explanation
        How well the map predicts places that are held out.
    survey
        What speaks against the readings as they were taken.
    """

    readings: int
    learning: LearningEnd
    searched: bool = False
    explanation: Explanation = UNJUDGED
    survey: tuple[str, ...] = ()


ORIGIN = TypeAdapter(Origin)


@dataclass(frozen=True)
class Learnt:
    """Everything that the tiles follow from.

    Attributes
    ----------
    readings
        Training readings, merged, map frame, metres and uT.
    hyperparameters
        Of the prior of the whole map.
    sources
        Candidate sources, map frame, metres.
    strengths
        Of each structure among them; 0 where the readings show none.
    tiling
        Square tiles in x and y of the map frame, metres.
    resolution
        Largest wave numbers of floor and ceiling modes in 1/m.
    local
        How far the prior of a tile may differ.
    origin
        How it was learnt; does not enter predictions.
    suite
        What errors of the sensors that surveyed do to the readings; absent where they count as
        exact.
    history
        Which drive each reading is of, and how far the field moved between drives; absent where all
        are of one field.
    poses
        What errors of the poses do to the readings; absent where they count as exact.
    """

    readings: TrainingSet
    hyperparameters: Hyperparameters
    sources: Sources
    strengths: FloatArray
    tiling: Tiling
    resolution: Resolution
    local: LocalOptions
    origin: Origin
    suite: SuiteErrors | None = None
    history: History | None = None
    poses: SurveyPoses | None = None

    @cached_property
    def members(self) -> list[IntArray]:
        """Rows of the readings that take part in each tile."""
        return self.tiling.grid.members(self.readings.points, self.tiling.overlap)

    @cached_property
    def most_variance(self) -> float:
        """Variance of the three axes together beyond which the field is not known, uT^2."""
        varied = float(self.readings.field.var(axis=0).sum())
        return max(KNOWN * varied, 3 * self.hyperparameters.noise**2)

    @cached_property
    def past(self) -> History:
        """What the readings went through: those of a map without history are of one drive."""
        return self.history or History.of_survey(len(self.readings), UNDATED)

    def basis(self, tile: int, rows: IntArray, visible: float = FINE) -> Basis:
        """Return the basis of a tile for its readings; ``visible`` is that of ``dipoles_of``."""
        centre, edge = self.tiling.grid.centres[tile], self.tiling.edge
        structures, strengths = self.structures(tile)
        return basis_of(
            self.readings[rows], centre, edge, self.resolution, structures, strengths, visible
        )

    def frame(self, tile: int) -> TileFrame:
        """Return the box of a tile."""
        points = self.readings.points[self.members[tile]]
        return tile_frame(points, self.tiling.grid.centres[tile], self.tiling.edge)

    def structures(self, tile: int) -> tuple[list[Sources], FloatArray]:
        """Return the structures in or near a tile that have a field, and their strengths, (S,)."""
        strong = self.structure_numbers(tile)
        return [self.sources.pieces[s] for s in strong], self.strengths[strong]

    def present(self, tile: int) -> IntArray:
        """Return the rows of a tile's readings since which its field has not moved."""
        rows, moved = self.members[tile], np.flatnonzero(self.moved_before(tile))
        return rows[self.past.drive[rows] >= (moved[-1] if len(moved) else 0)]

    def moved_before(self, tile: int) -> list[bool]:
        """Return before which drives the field of a tile moved, or structures near it changed."""
        steps = self.past.steps_of(self.tiling.grid.cells[tile])
        near = self.structure_numbers(tile)
        return [
            step.share > 0 or any(self.past.freed_before(k, near)) for k, step in enumerate(steps)
        ]

    def structure_numbers(self, tile: int) -> list[int]:
        """Return the numbers of the structures in or near a tile that have a field."""
        near = self.sources.within(self.tiling.grid.centres[tile], self.tiling.edge)
        return [s for s in near if self.strengths[s] > 0]

    def extended(
        self,
        new: TrainingSet,
        options: HarmonicOptions,
        suite: SuiteErrors | None = None,
        poses: SurveyPoses | None = None,
    ) -> "Learnt":
        """Return the same prior and tiles, with more readings and the tiles that they need.

        ``suite`` and ``poses`` are what errors of their sensors and poses do to the new readings.
        """
        if self.history is not None:  # readings of two drives are not averaged: see ``followed_by``
            return self.followed_by(new, options, suite, UNDATED, poses)
        new, suite = self.as_found(new, suite)
        together = joined(self.readings, new)
        owner = cubes_of(together.points, options.merge)
        errors = errors_together(self.suite, suite, len(self.readings))
        errors = None if errors is None else errors.averaged(owner, together.weight)
        wrong_poses = errors_together(self.poses, poses, len(self.readings))
        if wrong_poses is not None:
            wrong_poses = wrong_poses.averaged(owner, together.weight)
        readings = merged(together, options.merge, options.independent)
        learnt = self._of(readings, errors, survey_doubts(together), len(new), options)
        return replace(learnt, poses=wrong_poses)

    def followed_by(
        self,
        new: TrainingSet,
        options: HarmonicOptions,
        suite: SuiteErrors | None,
        drive: MapDrive,
        poses: SurveyPoses | None = None,
    ) -> "Learnt":
        """Return the same with the readings of a new drive, which stay apart from earlier ones.

        Parameters
        ----------
        new
            Its readings.
        options
            Of the map.
        suite
            What errors of their sensors do to them.
        drive
            When it was.
        poses
            What errors of their poses do to them.
        """
        new, suite = self.as_found(new, suite)
        owner = cubes_of(new.points, options.merge)
        own = None if suite is None else suite.averaged(owner, new.weight)
        errors = errors_together(self.suite, own, len(self.readings))
        own_poses = None if poses is None else poses.averaged(owner, new.weight)
        wrong_poses = errors_together(self.poses, own_poses, len(self.readings))
        added = merged(new, options.merge, options.independent)
        together = joined(self.readings, added)
        # Steel that came between two drives is no fault of a survey: each is doubted by itself.
        learnt = self._of(together, errors, survey_doubts(new), len(new), options)
        history = self.past.followed_by(len(added), drive)
        return replace(learnt, history=history, poses=wrong_poses)

    def as_found(
        self, new: TrainingSet, suite: SuiteErrors | None
    ) -> tuple[TrainingSet, SuiteErrors | None]:
        """Return new readings and their errors without what this survey found of the sensors."""
        if suite is None:
            return new, None
        suite = suite.as_found_by(self.suite)
        return replace(new, field=suite.corrected(new.field)), suite

    def only(self, keep: BoolArray, options: HarmonicOptions) -> "Learnt":
        """Return the same with some of the readings, (N,), and the tiles that they need."""
        rows = np.flatnonzero(keep)
        suite = None if self.suite is None else self.suite.only(keep)
        poses = None if self.poses is None else self.poses.only(keep)
        history = None if self.history is None else self.history.only(keep)
        learnt = self._of(self.readings[rows], suite, (), 0, options)
        return replace(learnt, history=history, poses=poses)

    def _of(
        self,
        readings: TrainingSet,
        suite: SuiteErrors | None,
        doubts: tuple[str, ...],
        added: int,
        options: HarmonicOptions,
    ) -> "Learnt":
        """Return the same prior over other readings, with their tiles; see ``extended``."""
        survey = tuple(dict.fromkeys((*self.origin.survey, *doubts)))
        grid = self.tiling.grid
        wider = grid_from(grid.origin, readings.points, grid.size, reach_of(grid.size, options))
        return replace(
            self,
            readings=readings,
            tiling=replace(self.tiling, grid=wider),
            origin=replace(self.origin, readings=self.origin.readings + added, survey=survey),
            suite=suite,
        )


def laid_out(
    readings: TrainingSet,
    learning: LearningEnd,
    sources: Sources,
    strengths: FloatArray,
    options: HarmonicOptions,
) -> Learnt:
    """Return readings and prior with the tiles that suit them."""
    density = float(readings.weight.sum()) / surveyed_area(readings.points)
    needed = [
        resolution_of(each, density, options.mode_share)
        for each in (learning.hyperparameters, *learning.roughest)
    ]
    resolution = affordable(finest(needed), options.tiling, options.modes)
    tiling = tiling_of(readings.points, resolution, options.tiling, options.modes, options.reach)
    origin = Origin(len(readings), learning)
    hyperparameters, local = learning.hyperparameters, options.effective_local
    return Learnt(readings, hyperparameters, sources, strengths, tiling, resolution, local, origin)


def reach_of(core: float, options: HarmonicOptions) -> float:
    """Return how far from the readings tiles lie, metres: each has readings in its overlap."""
    return min(options.reach, options.tiling.overlap, 0.49 * core)
