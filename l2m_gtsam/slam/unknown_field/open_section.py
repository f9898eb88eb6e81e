"""The last stretch of a drive through an unknown field, solved again as it grows."""

from collections.abc import Generator, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from types import MappingProxyType

import gtsam
import numpy as np

from l2m_factors import M, X
from l2m_gtsam.calibration.factor_graph import unit_priors
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.joint_gaussian import JointGaussian, is_pose, part_of, prior_factors, retracted
from l2m_gtsam.slam.key_pose_readings import joined_readings
from l2m_gtsam.slam.map_prediction import PlacedReadings, place_readings, sensors_in
from l2m_gtsam.slam.marginals import joint_posterior
from l2m_gtsam.slam.online.belief import POSE, Belief
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.pose_graph import between_factor, link_graph
from l2m_gtsam.slam.solver import colamd_ordering, marginals_of, stepwise_levenberg_marquardt
from l2m_gtsam.slam.unknown_field.field_memory import FieldMemory, RememberedTile, tile_of
from l2m_gtsam.slam.unknown_field.section_readings import SectionReadings, TileReadings
from l2m_gtsam.slam.unknown_field.tiled_drive import OccupiedTile
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, WaveTile, level_axes

# Noise of new readings in a stage before the last, as a multiple of the true: in a tile where the
# vehicle was, and where it comes to one as far off as odometry has drifted.
ONWARDS = (4.0,)
AGAIN = (16.0, 4.0)
CLOSE = 0.5  # decrease of the error: a step of a sigma, of hundreds of variables together
ONCE: Mapping[int, int] = MappingProxyType({})  # what waves leave out counts, in every tile
SOFT = 1.0  # convexity of the loss for new readings, mu of ``solve.robust``


class OpenSection:
    """The last stretch of a drive, with the memory at its beginning as the prior.

    Parameters
    ----------
    sensors, prior, options
        Calibrations, the prior of the field, how to solve.
    memory
        Joint Gaussian of ``X(first)``, the tiles and the calibrations that are variables.
    first
        Its first key pose; readings before it have counted in the section before.
    before
        Tiles of the section before, which the vehicle does not come to anew.

    Attributes
    ----------
    field_prior
        The prior of the field.
    key_poses
        All after the first.
    moved_m
        How far readings moved one of them when they were solved last, at most.
    """

    def __init__(
        self,
        sensors: KnownSensors,
        prior: FieldPrior,
        options: SlamOptions,
        memory: FieldMemory,
        first: int,
        before: Set[int] = frozenset(),
    ) -> None:
        self._sensors = sensors_in(memory.known.values, sensors)
        self.field_prior, self._options = prior, options
        self._memory, self._tiles = memory, list(memory.tiles)
        self._calibrations = memory.calibrations
        self._first = self._last = first
        self._tiles_before = before
        self.key_poses: list[ArrivedKeyPose] = []
        self._fixed = None if self._calibrations else sensors.fixed()
        self._of_section = SectionReadings(joined_readings([]), self._fixed)
        self._shared = [X(first), *self._calibrations]  # with the memory
        self._values = part_of(memory.known.values, self._shared)
        self._tile_of: dict[int, int] = {}
        self._counted: list[TileReadings] = []
        self.moved_m = 0.0
        self._prior: gtsam.NonlinearFactorGraph | None = None
        self._after = memory.known  # of the variables that the memory keeps or shares
        self._promised = 0.0  # decrease of the error by another step

    def begun_anew(self) -> "OpenSection":
        """Return the same section without key poses, as which other ones may be solved."""
        return self._anew(self._memory, self._first, self._tiles_before)

    def log_likelihood(self) -> float:
        """Return that of its readings, poses and field integrated out about the solution.

        Sections from one memory whose steps differ are compared by it.
        """
        graph = self._factors(self._counted)
        prior = self._memory.known.marginal(self._shared)
        graph.push_back(prior_factors(prior))
        left = marginals_of(graph, self._values).log_determinant()
        known = np.linalg.slogdet(prior.covariance)[1]
        known += sum(np.linalg.slogdet(each.covariance)[1] for each in self.key_poses)
        largest = self._options.robust.largest
        volume = sum(each.log_volume(self._sensors, largest) for each in self._counted)
        return float(volume - graph.error(self._values) - left - 0.5 * known)

    def extended(self, new: Sequence[ArrivedKeyPose]) -> Iterator[None]:
        """Add key poses and solve.

        Yields between pieces of the work, of a linearisation each.
        """
        self.key_poses += [each for each in new if each.number > self._first]
        parts = [each.readings for each in self.key_poses]
        self._of_section = SectionReadings(joined_readings(parts), self._fixed)
        self._predict(new)
        if any(len(each.links) for each in new):
            yield from self._moved_by_loops(new)
        before = self._places()
        numbers = [each.number for each in new]
        if self._first not in self._tile_of:
            numbers = [self._first, *(k for k in numbers if k > self._first)]
        entered = [self._enter(k) for k in numbers]
        for scale in AGAIN if any(entered) else ONWARDS:
            self._counted = self._weighed(numbers[0], scale)
            graph = self._factors(self._counted)
            yield
            graph.push_back(self._prior_factors())
            yield from self._solved(graph, 1)
        self._counted = self._weighed(numbers[0], 1.0)
        graph = yield from self._whole(self._counted)
        yield from self._solved(graph, 1)
        yield from self._looked_at(graph)
        if self._promised > CLOSE:
            yield from self._solved(graph, self._options.max_iterations - 1)
            yield from self._looked_at(graph)
        self.moved_m = float(np.linalg.norm(self._places() - before, axis=1).max(initial=0.0))
        yield

    def belief(self) -> Belief:
        """Return the posterior of the last key pose."""
        known = self._after.marginal([X(self._last), *self._calibrations])
        return Belief(self.pose(self._last), self._sensors, known.covariance)

    def closed(self) -> Generator[None, None, FieldMemory]:
        """Return the memory updated by the section; yields between pieces of the work."""
        posterior = yield from self._remembered()
        anchors = {X(tile.anchor) for tile in self._tiles}
        let_go = {X(self._first)} - anchors - {X(self._last)}
        known = yield from self._memory.known.updated(posterior, let_go)
        yield
        tiles = list(self._tiles)
        for each in self._counted:
            tile = tiles[each.laid.number]
            tiles[tile.number] = replace(
                tile, past_information=tile.past_information + each.information()
            )
        return FieldMemory(known, tuple(tiles))

    def _remembered(self) -> Generator[None, None, JointGaussian]:
        """Return the section's posterior, of which the memory learns nothing twice.

        What the waves of a tile leave out is the same at each visit: counted anew each time it
        would average out over laps. The last pose suffers from it once. All else is known as where
        it counts as often as the vehicle has come back to the tile, so that more visits tell little
        more, and the last pose follows it as by the readings as they are.
        """
        times = {number: max(self._tiles[number].returns, 1) for number in self._tile_of.values()}
        if max(times.values()) == 1:
            return self._after
        none_is_new = self._last + 2  # readings come with the key pose after them
        self._counted = self._weighed(none_is_new, 1.0, times)
        graph = yield from self._whole(self._counted)
        linear, keys = graph.linearize(self._values), self._kept()[:-1]
        yield
        found, sizes = joint_posterior(linear, keys), {key: self._size(key) for key in keys}
        yield
        values = retracted(part_of(self._values, keys), sizes, found.mean)
        return (yield from self._after.updated(JointGaussian(values, sizes, found.covariance)))

    def next(self, memory: FieldMemory, first: int) -> "OpenSection":
        """Return a new section from a key pose on."""
        return self._anew(memory, first, frozenset(self._tile_of.values()))

    def _anew(self, memory: FieldMemory, first: int, before: Set[int]) -> "OpenSection":
        return OpenSection(self._sensors, self.field_prior, self._options, memory, first, before)

    def pose(self, number: int) -> gtsam.Pose3:
        """Return the estimate of a key pose of the section, or of the memory."""
        known = self._memory.known.values
        return (self._values if self._values.exists(X(number)) else known).atPose3(X(number))

    def tile(self, number: int) -> RememberedTile:
        """Return the tile of a key pose of the section."""
        return self._tiles[self._tile_of[number]]

    def _predict(self, new: Sequence[ArrivedKeyPose]) -> None:
        """Initialise new key poses by odometry."""
        for each in new:
            if each.number > self._first:
                there = self.pose(each.number - 1).compose(each.step)
                self._values.insert(X(each.number), there)
                self._last = each.number

    def _moved_by_loops(self, new: Sequence[ArrivedKeyPose]) -> Generator[None, None, None]:
        """Move the section's poses to where new loops of scans put them.

        That is before readings are assigned to tiles: scans know a place from further off.
        """
        self._share([X(origin) for each in new for origin in each.links.origin.tolist()])
        graph, shared = self._motions(), [key for key in self._shared if is_pose(key)]
        graph.push_back(prior_factors(self._memory.known.marginal(shared)))
        poses = [*shared, *(X(each.number) for each in self.key_poses)]
        values, most = part_of(self._values, poses), self._options.max_iterations
        order = colamd_ordering(graph)
        found = yield from stepwise_levenberg_marquardt(graph, values, order, most, CLOSE)
        self._values.update(found.values)
        yield

    def _places(self) -> FloatArray:
        """Return where the section's key poses are in metres, shape (K, 3)."""
        places = [self.pose(each.number).translation() for each in self.key_poses]
        return np.array(places).reshape(-1, 3)

    def _enter(self, k: int) -> bool:
        """Assign a key pose to its tile; return whether the vehicle comes to it anew."""
        anchors = [self.pose(tile.anchor) for tile in self._tiles]
        number = tile_of(self.pose(k), anchors, self.field_prior.options.core)
        self._tile_of[k] = number
        if number == len(self._tiles):
            field = self._waves(k)
            self._tiles.append(RememberedTile.new(number, k, field))
            self._values.insert(M(number), np.zeros(len(field)))
            return False
        if self._values.exists(M(number)):
            return False
        tile = self._tiles[number]
        self._share([X(tile.anchor), M(number)])
        if number in self._tiles_before:
            return False
        self._tiles[number] = replace(tile, returns=tile.returns + 1)
        return True

    def _share(self, keys: Sequence[int]) -> None:
        """Take variables of the memory into the section; those of its own stay."""
        for key in keys:
            if key not in self._memory.known.sizes:
                continue
            if not self._values.exists(key):
                self._values.insert(part_of(self._memory.known.values, [key]))
            self._shared.append(key)
        self._shared, self._prior = list(dict.fromkeys(self._shared)), None

    def _waves(self, anchor: int) -> WaveTile:
        """Return the waves of a new tile at a key pose; sensors and readings bound its height."""
        R, count = self.pose(anchor).rotation().matrix(), len(self._of_section.readings)
        level, options = R.T @ level_axes(R[None])[0], self.field_prior.options
        x = self._sensors.t
        if count:
            x = np.vstack([x, self._place(np.arange(count), anchor).x])
        near = np.abs(x @ level[:, :2]).max(axis=1) <= options.edge / 2
        return WaveTile.about(self.field_prior, level, x[near] if near.any() else x)

    def _place(self, rows: IntArray, anchor: int) -> PlacedReadings:
        readings, origin = self._of_section.readings[rows], self.pose(anchor)
        own = {int(k): origin.between(self.pose(int(k))) for k in np.unique(readings.key_pose)}
        return place_readings(readings, own, self._sensors)

    def _weighed(
        self, new: int, scale: float, times: Mapping[int, int] = ONCE
    ) -> list[TileReadings]:
        """Return all readings with weights by their tiles' current predictions.

        Parameters
        ----------
        new
            Readings since this key pose are weighed softly,
        scale
            and have this multiple of their noise.
        times
            How often what a tile's waves leave out counts, by its number; once if not given.
        """
        key = self._of_section.readings.key_pose
        owner = np.array([self._tile_of[int(k)] for k in key], dtype=np.int64)
        return [
            self._weighed_in(
                self._tiles[number],
                np.flatnonzero(owner == number),
                new,
                scale,
                times.get(number, 1),
            )
            for number in np.unique(owner).tolist()
        ]

    def _factors(self, counted: Sequence[TileReadings]) -> gtsam.NonlinearFactorGraph:
        """Return the factors of all but the memory."""
        graph, old = self._motions(), len(self._memory.tiles)
        graph.push_back(unit_priors({M(t.number): len(t.field) for t in self._tiles[old:]}))
        for each in counted:
            for factor in each.factors():
                graph.add(factor)
        return graph

    def _whole(
        self, counted: Sequence[TileReadings]
    ) -> Generator[None, None, gtsam.NonlinearFactorGraph]:
        """Return the factors of the last stage, the memory's among them, in pieces of work."""
        graph = self._factors(counted)
        yield
        for each in counted:
            for factor in each.penalties(self._tiles[each.laid.number]):
                graph.add(factor)
            yield
        graph.push_back(self._prior_factors())
        return graph

    def _motions(self) -> gtsam.NonlinearFactorGraph:
        """Return odometry and loops of scans."""
        graph = gtsam.NonlinearFactorGraph()
        for each in self.key_poses:
            graph.add(between_factor(each.number - 1, each.step, each.covariance))
            graph.push_back(link_graph(each.links))
        return graph

    def _weighed_in(
        self, tile: RememberedTile, rows: IntArray, new: int, scale: float, times: int
    ) -> TileReadings:
        """Return the readings of a tile; other arguments as of ``_weighed``."""
        sensors, readings = self._sensors, self._of_section.readings
        laid = OccupiedTile(
            tile.number, tile.anchor, rows, tile.field, self._place(rows, tile.anchor)
        )
        recent = readings.key_pose[rows] >= new - 1  # they come with the key pose after them
        if not self._values.atVector(M(tile.number)).any():
            likely = laid.robust_weights(sensors, scale * sensors.noise)
            self._values.update(M(tile.number), likely)
        prediction = laid.prediction(self._values.atVector(M(tile.number)), sensors)
        noise = sensors.noise[readings.sensor[rows]] * np.where(recent, scale, 1.0)
        mu = np.where(recent, SOFT, np.inf)
        robust = self._options.robust
        return TileReadings.weighed(self._of_section, laid, prediction, noise, mu, robust, times)

    def _prior_factors(self) -> gtsam.NonlinearFactorGraph:
        """Return the memory's factors on the variables that it shares."""
        if self._prior is None:
            self._prior = prior_factors(self._memory.known.marginal(self._shared))
        return self._prior

    def _solved(self, graph: gtsam.NonlinearFactorGraph, most: int) -> Generator[None, None, None]:
        """Solve for all variables of the section, with a limit of steps."""
        order = colamd_ordering(graph)
        found = yield from stepwise_levenberg_marquardt(graph, self._values, order, most, CLOSE)
        self._values = found.values
        self._sensors = sensors_in(self._values, self._sensors)
        yield

    def _looked_at(self, graph: gtsam.NonlinearFactorGraph) -> Iterator[None]:
        """Linearise where it was solved: what is known then, and what another step promises.

        The one elimination tells both; a step to see that the error stays would be another.
        """
        linear, keys = graph.linearize(self._values), self._kept()
        yield
        found = joint_posterior(linear, keys)
        sizes = {key: self._size(key) for key in keys}
        self._after = JointGaussian(part_of(self._values, keys), sizes, found.covariance)
        self._promised = found.decrease
        yield

    def _kept(self) -> list[int]:
        """Return the variables that the memory keeps or shares, the last pose at the end."""
        tiles = [self._tiles[number] for number in sorted(set(self._tile_of.values()))]
        last = X(self._last)
        shared = [key for key in self._shared if is_pose(key)]
        own = dict.fromkeys([*shared, *(X(tile.anchor) for tile in tiles)])
        own.pop(last, None)
        return [*own, *(M(tile.number) for tile in tiles), *self._calibrations, last]

    def _size(self, key: int) -> int:
        if gtsam.symbolChr(key) == ord("M"):
            return len(self._tiles[gtsam.symbolIndex(key)].field)
        return self._memory.known.sizes[key] if key in self._calibrations else POSE
