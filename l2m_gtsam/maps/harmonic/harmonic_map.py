"""A map of harmonic potentials: tiles of floor and ceiling modes, uniform field and sources."""

from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.data import FieldAndGradient, FieldSample, FloatArray, IntArray, MapState
from l2m_gtsam.maps.field_map import MapSummary, masked, unknown
from l2m_gtsam.maps.harmonic.compiled import CompiledTiles
from l2m_gtsam.maps.harmonic.error_modes import ErrorModes, MovedTiles, error_modes, tile_modes
from l2m_gtsam.maps.harmonic.learnt import ErrorOptions, HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.pose_sizes import with_pose_errors
from l2m_gtsam.maps.harmonic.state import learnt_from_state, learnt_to_state
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES, candidate_sources
from l2m_gtsam.maps.harmonic.suite_sizes import sized, stated_doubts, suite_sizes, with_errors_found
from l2m_gtsam.maps.harmonic.summary import summary_of
from l2m_gtsam.maps.harmonic.teaching import explained, learn_map
from l2m_gtsam.maps.harmonic.tile_shares import Blend, TilePoints
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.maps.tile_store import TileStore
from l2m_gtsam.maps.training import (
    TrainingSet,
    additional_set,
    checked_points,
    cubes_of,
    training_set,
)
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.progress import Count
from l2m_gtsam.records.map_diary import MapDiary

EXACT = 1e-9  # share of the variance between points that may be left out
SHARES = 4  # that points are divided into, for as many threads at most
PIECE = 65_536  # about the most points of a share
BLOCK = 0.5  # metres: what a map knows of a square of this size fits the processor's cache
SERIAL = 6_000  # fewer points than this are not worth threads
FEW = 32  # the same of their variance, a hundred times as slow


@dataclass(frozen=True)
class HarmonicMap:
    """A field map of harmonic potentials on blending tiles.

    Attributes
    ----------
    learnt
        Readings (map frame, metres and uT), prior, sources and tiling.
    options
        Options of the map, lengths in metres.
    tiles
        One for each cell of the tiling, solved when first needed.
    frame
        Name of the map frame; None where it is not known.
    """

    kind: ClassVar[str] = "harmonic"
    learnt: Learnt
    options: HarmonicOptions
    tiles: Tiles
    _: KW_ONLY
    frame: str | None = None

    @classmethod
    def fit(
        cls,
        points: FloatArray,
        field: FloatArray,
        options: HarmonicOptions | None = None,
        cloud: FloatArray | None = None,
        suite: SuiteErrors | None = None,
        poses: SurveyPoses | None = None,
    ) -> "HarmonicMap":
        """Return the map of readings.

        Parameters
        ----------
        points
            Positions of the readings in the map frame in metres, shape (N, 3).
        field
            Readings in the map frame in microtesla, shape (N, 3).
        options
            Defaults where absent.
        cloud
            Points of the structure that a LiDAR saw, in the map frame in metres, shape (M, 3).
        suite
            What errors of the sensors do to the readings. Where none are stated they are looked
            for in the readings; without this the sensors count as exact.
        poses
            The same for the errors of the poses.

        Raises
        ------
        MapError
            If no map can be made of the readings.
        """
        options = HarmonicOptions() if options is None else options
        readings, sources = training_set(points, field), NO_SOURCES
        if cloud is not None:
            sources = candidate_sources(checked_points(cloud), readings.points, options.structure)
        learnt = learn_map(readings, sources, options)
        owner = cubes_of(readings.points, options.merge)
        if suite is None:
            ours = cls.condition(learnt, options)
        else:
            ours = cls.surveyed_by(learnt, options, suite.averaged(owner, readings.weight))
            if suite.stated and not suite.calibrated_together:
                learnt = with_errors_found(ours.learnt, readings, suite, sources, options)
                ours = cls.condition(learnt, options)
        return ours if poses is None else ours.posed(poses.averaged(owner, readings.weight))

    @classmethod
    def surveyed_by(
        cls, learnt: Learnt, options: HarmonicOptions, suite: SuiteErrors
    ) -> "HarmonicMap":
        """Return the map with the errors of its sensors: stated, or as the survey shows them."""
        exact = cls.condition(learnt, options)
        if suite.stated:
            doubts = stated_doubts(learnt, exact.tiles, suite)
            learnt = replace(learnt, suite=suite)
            return cls(learnt, options, Tiles(learnt, exact.tiles.solved)).doubted(doubts)
        sizes = suite_sizes(learnt, exact.tiles, suite)
        if sizes is None:
            return exact
        learnt = replace(learnt, suite=sized(suite, sizes))
        # The tiles are the same: errors of sensors enter what is asked of them.
        return cls(learnt, options, Tiles(learnt, exact.tiles.solved)).doubted((sizes.doubt,))

    def posed(self, poses: SurveyPoses) -> "HarmonicMap":
        """Return the map with the errors of its poses: stated, or as the survey shows them."""
        learnt = with_pose_errors(self.learnt, self.tiles, poses, self.options)
        return self if learnt is None else self.condition(learnt, self.options)

    @classmethod
    def condition(cls, learnt: Learnt, options: HarmonicOptions) -> "HarmonicMap":
        """Return the map whose prior is known."""
        return cls(learnt, options, Tiles(learnt))

    def errors_over(self, points: FloatArray, /) -> ErrorModes:
        """Return the map's error over places, shape (N, 3) in metres, as correlated numbers."""
        places = checked_points(points)
        return error_modes(self.learnt, self.tiles, self._moved, places, self.options.errors)

    @cached_property
    def _moved(self) -> MovedTiles:
        return MovedTiles(self.learnt)

    def tile_of(self, points: FloatArray, /) -> IntArray:
        """Return which tile answers at each place, shape (N,)."""
        return self.learnt.tiling.grid.block_of(points)

    def weights_in(self, tile: int, points: FloatArray, /) -> int:
        """Return of how many numbers the errors are at places in a tile."""
        return len(tile_modes(self.tiles[tile], points, self.options.errors))

    def updated(
        self,
        points: FloatArray,
        field: FloatArray,
        suite: SuiteErrors | None = None,
        poses: SurveyPoses | None = None,
        /,
    ) -> "HarmonicMap":
        """Return the map with more readings and the same prior of the whole; see ``FieldMap``.

        Only tiles that the new readings take part in are solved again, with scales of their own
        anew; whether the field is explained is judged anew as well.
        """
        new, old_suite = additional_set(points, field), self.learnt.suite
        if suite is not None and not suite.stated:  # as exact as before
            suite = None if old_suite is None else suite.as_sure_as(old_suite)
        poses = None if poses is None else poses.like(self.learnt.poses)
        learnt = explained(self.learnt.extended(new, self.options, suite, poses), self.options)
        # A new reading may have moved an old one that it was merged with.
        box = 0.5 * learnt.tiling.grid.size + learnt.tiling.overlap + self.options.merge
        away, _ = cKDTree(new.points[:, :2]).query(learnt.tiling.grid.centres, p=np.inf)
        touched = np.asarray(away) <= box
        solved = self.tiles.solved
        old = {tuple(cell): i for i, cell in enumerate(self.learnt.tiling.grid.cells.tolist())}
        kept = {
            index: solved[old[tuple(cell)]]
            for index, cell in enumerate(learnt.tiling.grid.cells.tolist())
            if not touched[index] and old.get(tuple(cell)) in solved
        }
        return self._formed(
            HarmonicMap(learnt, self.options, Tiles(learnt, kept), frame=self.frame)
        )

    def _formed(self, plain: "HarmonicMap") -> "HarmonicMap":
        """Return a map in the form that this one has."""
        return plain

    @classmethod
    def from_state(cls, state: MapState) -> "HarmonicMap":
        """Return the map that ``to_state`` took apart.

        Raises
        ------
        MapError
            If the state is damaged.
        """
        learnt, options = learnt_from_state(state)
        return cls.condition(learnt, options)

    def doubted(self, doubts: tuple[str, ...]) -> "HarmonicMap":
        """Return the map with more that speaks against its survey, a sentence each."""
        origin = self.learnt.origin
        learnt = replace(self.learnt, origin=replace(origin, survey=(*origin.survey, *doubts)))
        return replace(self, learnt=learnt)

    def in_frame(self, frame: str | None, /) -> Self:
        """Return the map with another name of its frame."""
        return replace(self, frame=frame)

    def with_store(self, store: TileStore) -> "HarmonicMap":
        """Return the map that keeps its tiles in a store, and takes from it those that it has."""
        return replace(self, tiles=Tiles(self.learnt, self.tiles.solved, store))

    def make_tiles(self, progress: Count) -> int:
        """Have all tiles in the store, as far as it takes them; see ``CompiledTiles``."""
        return CompiledTiles.of(self.learnt, self.options, self.tiles).make_all(progress)

    def to_state(self) -> MapState:
        """Return the map as plain arrays and facts."""
        return learnt_to_state(self.kind, self.learnt, self.options)

    @property
    def readings(self) -> TrainingSet:
        """Readings in the map frame, merged."""
        return self.learnt.readings

    @property
    def diary(self) -> MapDiary | None:
        """Drives and what changed between them; None where it was not kept up."""
        return None if self.learnt.history is None else self.learnt.history.diary

    @property
    def sensors_uncertain(self) -> bool:
        """Whether errors of the sensors that surveyed are stated."""
        return self.learnt.suite is not None

    @property
    def poses_uncertain(self) -> bool:
        """Whether errors of the poses that surveyed are stated, or were found."""
        return self.learnt.poses is not None

    @property
    def errors_over_stated(self) -> float:
        """How many times what the map states the errors at held-out readings are, 1 at least."""
        return self.learnt.origin.explanation.errors_over_stated

    @property
    def summary(self) -> MapSummary:
        """Figures of the map."""
        return summary_of(self.kind, self.learnt)

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance; see ``FieldMap``."""
        points = checked_points(points)
        away, _ = self.readings.tree.query(points, distance_upper_bound=self.options.reach)
        near = np.flatnonzero(np.isfinite(away))
        known = unknown(len(points))
        # Values elsewhere would not be used.
        known.field[near], known.gradient[near], known.variance[near] = self._answers(points[near])
        known.inside[near] = known.variance[near].sum(axis=1) <= self.learnt.most_variance
        return masked(known)

    def _answers(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return field, gradient and variance at points, also outside."""
        blend, variance = Blend.of(len(points)), np.empty_like(points)
        parts, owner = self.learnt.tiling.by_tile(points), self.learnt.tiling.grid.block_of(points)

        def answer(part: TilePoints) -> tuple[FloatArray, FloatArray]:
            # All points of a tile at once: it may not stay in memory.
            tile, at = self.tiles[part.tile], points[part.rows]
            own = owner[part.rows] == part.tile
            variance[part.rows[own]] = tile.variance(at[own])
            return tile.field_and_gradient(at)

        for part, values in zip(parts, in_threads(answer, parts), strict=True):
            blend.add(part.rows, part.share, values)
        return blend.field, blend.gradient, variance

    def compile(self) -> "CompiledMap":
        """Return the form for solvers: the same field within 5 nT and 20 nT/m, and far faster.

        Whoever asks again shares the tiles that are compiled already.
        """
        whole = self.learnt, self.options, self.tiles
        return CompiledMap(*whole, self._compiled, frame=self.frame)

    @cached_property
    def _compiled(self) -> CompiledTiles:
        return CompiledTiles.of(self.learnt, self.options, self.tiles)

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient, also outside; see ``FieldMap``."""
        points = checked_points(points)
        blend = Blend.of(len(points))
        for part in self.learnt.tiling.by_tile(points):
            values = self.tiles[part.tile].field_and_gradient(points[part.rows])
            blend.add(part.rows, part.share, values)
        return blend.field, blend.gradient

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis, also outside; see ``FieldMap``."""
        points = checked_points(points)
        owner = self.learnt.tiling.grid.block_of(points)
        variance = np.empty_like(points)

        def answer(tiles: IntArray) -> None:
            # Neighbours know a place about equally well: that of the core it lies in speaks for it.
            for tile in tiles.tolist():
                rows = np.flatnonzero(owner == tile)
                variance[rows] = self.tiles[tile].variance(points[rows])

        tiles = np.unique(owner)
        in_threads(answer, np.array_split(tiles, max(1, min(len(points) // FEW, len(tiles)))))
        return variance

    def covariance(self, points: FloatArray) -> FloatArray:
        """Return the covariance of the map's errors at all points, uT^2, shape (N, 3, N, 3).

        Of points in one tile it is the posterior's; of points in two it comes from the readings
        that both know, see ``error_modes``. Its diagonal is ``variance``.

        Parameters
        ----------
        points
            In the map frame in metres, shape (N, 3).
        """
        points = checked_points(points)
        count = len(points)
        if not count:
            return np.empty((0, 3, 0, 3))
        every = ErrorOptions(places=max(count, 10), rest=EXACT)
        errors = error_modes(self.learnt, self.tiles, self._moved, points, every)
        A = np.zeros((3 * count, len(errors.covariance)))
        owner, start = errors.owner(points), 0
        for tile, size in errors.sizes().items():
            rows = np.flatnonzero(owner == tile)
            features = errors.features(points[rows], tile).reshape(-1, size)
            A[(3 * rows[:, None] + np.arange(3)).ravel(), start : start + size] = features
            start += size
        covariance = A @ errors.covariance @ A.T
        # What was left out, and waves too short for the tile, belong to each point alone.
        rest = self.variance(points).ravel() - covariance.diagonal()
        covariance[np.diag_indices_from(covariance)] += np.maximum(rest, 0.0)
        return np.asarray(covariance.reshape(count, 3, count, 3))


@dataclass(frozen=True)
class CompiledMap(HarmonicMap):
    """A harmonic map whose field and gradient come from grids, within 5 nT and 20 nT/m.

    That holds wherever the exact map is near readings; elsewhere the exact tiles answer.
    Everything but field and gradient is that of the exact map.

    Attributes
    ----------
    compiled
        The tiles, compiled on first use.
    """

    compiled: CompiledTiles

    def compile(self) -> "CompiledMap":
        """Return the map itself."""
        return self

    def _answers(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        return *self.field_and_gradient(points), self.variance(points)

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient, also outside; see ``FieldMap``."""
        points = checked_points(points)
        if len(points) < SERIAL:
            return self.compiled.blended(points)
        field, gradient = np.empty((len(points), 3)), np.empty((len(points), 3, 3))

        def answer(rows: IntArray) -> None:
            field[rows], gradient[rows] = self.compiled.blended(points[rows])

        in_threads(answer, np.array_split(by_place(points), max(SHARES, len(points) // PIECE)))
        return field, gradient

    def _formed(self, plain: HarmonicMap) -> HarmonicMap:
        return plain.compile()


def by_place(points: FloatArray) -> IntArray:
    """Return the indices of points, shape (N,), in an order that stays in one place at a time.

    Threads that are given parts of it meet few tiles in common.
    """
    across, along = (np.floor((at - at.min()) / BLOCK) for at in points[:, :2].T)
    # Numbers of 16 bits are sorted in linear time; where they run over, places take turns.
    numbers = (across * (along.max() + 1) + along) % 2**16
    return np.argsort(numbers.astype(np.uint16), kind="stable")
