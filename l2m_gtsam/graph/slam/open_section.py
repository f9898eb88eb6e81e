"""The last stretch of a drive through an unknown field, solved again as it grows."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import D, M, T, TileBatch, X, doubt_factor, tile_factor
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.graph.slam.belief import POSE, Belief
from l2m_gtsam.graph.slam.dense_descent import Descent, Prior, descended
from l2m_gtsam.graph.slam.drive import Drive, KnownSensors
from l2m_gtsam.graph.slam.factors import step_factor
from l2m_gtsam.graph.slam.field_prior import FieldPrior
from l2m_gtsam.graph.slam.joint_gaussian import JointGaussian, part_of
from l2m_gtsam.graph.slam.options import SlamOptions
from l2m_gtsam.graph.slam.sight import Sight, place, sensors_in
from l2m_gtsam.graph.slam.tiled import LaidTile
from l2m_gtsam.graph.slam.tiles import WaveTile, level_axes, tile_about
from l2m_gtsam.solve.robust import WEIGHTS

NOTHING = 1e-6  # a weight that is as good as none
# How many times their noise readings that are new may be off, stage by stage: where the vehicle was
# just before, and where it comes to after having been away.
ONWARDS = (4.0, 1.0)
AGAIN = (16.0, 4.0, 1.0)
SOFT = 1.0  # how sharply good ones among them are told from wrong ones, mu of ``solve.robust``


@dataclass(frozen=True)
class ExploredTile:
    """A tile of the field as it is remembered.

    Attributes
    ----------
    number, anchor
        Its own, and of the key pose that it is fixed to.
    field
        What its weights mean.
    taught
        What readings that were let go have told about its m weights, shape (m, m).
    """

    number: int
    anchor: int
    field: WaveTile
    taught: FloatArray


class OpenSection:
    """A stretch of a drive, and what was known where it began.

    Parameters
    ----------
    drive, prior, options
        The drive, the prior of its field, how to solve.
    known
        What is known of all that is remembered: ``X(first)``, anchors, weights, calibrations.
    tiles
        That are remembered.
    first
        Its first key pose. The readings on it count unless it is the last of another section.
    """

    def __init__(
        self,
        drive: Drive,
        prior: FieldPrior,
        options: SlamOptions,
        known: JointGaussian,
        tiles: tuple[ExploredTile, ...],
        first: int,
    ) -> None:
        self._drive, self._field_prior, self._options = drive, prior, options
        self._known, self._old, self._tiles = known, len(tiles), list(tiles)
        self._first, self._last = first, first - 1 if first == 0 else first
        self._ends = np.searchsorted(drive.readings.key_pose, np.arange(len(drive) + 1))
        self._calibrations = [key for key in known.sizes if gtsam.symbolChr(key) in b"TD"]
        self._shared = [X(first)]
        self._prior: Prior | None = None
        self._values = part_of(known.values, [*self._calibrations, X(first)])
        self._tile_of: dict[int, int] = {}
        self._rows, self._weights = np.empty(0, dtype=np.int64), np.empty(0)
        self._descent: Descent | None = None
        self.steps = 0

    def extend(self, last: int) -> Belief:
        """Take the key poses up to one, and return what is known of it then."""
        new = range(self._last + 1, last + 1)
        stages = self._placed(new)
        fresh = np.arange(self._ends[new.start], self._ends[new.stop])
        self._rows = np.concatenate([self._rows, fresh])
        self._weights = np.append(self._weights, np.ones(len(fresh)))
        self._last = last
        recent = np.arange(len(self._rows)) >= len(self._rows) - len(fresh)
        for scale in stages[:-1]:
            self._solve(recent, scale, 1, False)
        self._solve(recent, stages[-1], self._options.max_iterations, True)
        return self._belief()

    def closed(self) -> tuple[JointGaussian, tuple[ExploredTile, ...]]:
        """Return what is known at its end, and of which tiles."""
        assert self._descent is not None
        kept = self._kept()
        after = self._known.told(self._descent.last(len(kept)))
        anchors = [X(tile.anchor) for tile in self._tiles]
        left = [
            key for key in after.sizes
            if key != X(self._first) or key in anchors or self._first == self._last
        ]
        tiles = list(self._tiles)
        for laid, seen in self._seen():
            at = np.searchsorted(self._rows, laid.rows)
            variance = self._variance(laid) / np.maximum(self._weights[at], NOTHING)[:, None]
            more = laid.field.information(laid.place.x, variance)
            tiles[laid.number] = replace(
                tiles[laid.number], taught=tiles[laid.number].taught + more
            )
        return after.marginal(left), tuple(tiles)

    def values(self) -> gtsam.Values:
        """Return its variables."""
        return self._values

    def _placed(self, new: range) -> tuple[float, ...]:
        """Predict key poses and lay them on tiles; return the stages to solve them in."""
        stages, core = ONWARDS, self._field_prior.options.core
        for k in new:
            if k > self._first:
                before = self._values.atPose3(X(k - 1))
                self._values.insert(X(k), before.compose(self._drive.step(k - 1)))
            number = self._tile_about(self._values.atPose3(X(k)), core)
            if number == len(self._tiles):
                self._lay(k, new)
            elif X(self._tiles[number].anchor) not in self._shared and number < self._old:
                stages = AGAIN
            self._touch(number)
            self._tile_of[k] = number
        return stages

    def _tile_about(self, pose: gtsam.Pose3, core: float) -> int:
        if not self._tiles:
            return 0
        anchors = [self._pose(tile.anchor) for tile in self._tiles]
        axes = level_axes(np.stack([each.rotation().matrix() for each in anchors]))
        places = np.stack([each.translation() for each in anchors])
        return tile_about(pose.translation(), axes, places, core)

    def _pose(self, number: int) -> gtsam.Pose3:
        values = self._values if self._values.exists(X(number)) else self._known.values
        return values.atPose3(X(number))

    def _lay(self, anchor: int, new: range) -> None:
        """Lay a tile about a key pose; readings near by tell at which heights."""
        pose = self._values.atPose3(X(anchor))
        rows = np.append(self._rows, np.arange(self._ends[new.start], self._ends[anchor + 1]))
        R = pose.rotation().matrix()
        level = R.T @ level_axes(R[None])[0]
        near = self._where(rows, anchor)
        field = WaveTile.about(self._field_prior, level, near.x)
        number = len(self._tiles)
        self._tiles.append(
            ExploredTile(number, anchor, field, np.zeros((len(field), len(field))))
        )

    def _touch(self, number: int) -> None:
        """Make a tile's variables those of the section."""
        tile = self._tiles[number]
        if self._values.exists(M(number)):
            return
        if number < self._old:
            for key in (X(tile.anchor), M(number)):
                if key not in self._shared:
                    self._shared.append(key)
                    if not self._values.exists(key):
                        self._values.insert(part_of(self._known.values, [key]))
            self._prior = None
        else:
            self._values.insert(M(number), np.zeros(len(tile.field)))

    def _where(self, rows: IntArray, anchor: int):
        readings, origin = self._drive.readings[rows], self._pose(anchor)
        own = {int(k): origin.between(self._pose(int(k))) for k in np.unique(readings.key_pose)}
        return place(readings, own, self._sensors)

    @property
    def _sensors(self) -> KnownSensors:
        return sensors_in(self._values, self._drive.sensors)

    def _seen(self) -> Iterator[tuple[LaidTile, Sight]]:
        """Yield each tile with its readings, and what it says of them."""
        owner = np.array([self._tile_of[int(k)] for k in self._drive.readings.key_pose[self._rows]])
        for number in np.unique(owner).tolist():
            tile, rows = self._tiles[number], self._rows[owner == number]
            laid = LaidTile(number, tile.anchor, rows, tile.field, self._where(rows, tile.anchor))
            yield laid, laid.sight(self._values.atVector(M(number)), self._sensors)

    def _variance(self, laid: LaidTile) -> FloatArray:
        noise = self._drive.sensors.noise[laid.place.readings.sensor, None]
        return noise**2 + laid.field.unresolved(laid.place.x)

    def _solve(self, recent, times: float, most: int, last: bool) -> None:
        """Solve the section, with so many times the noise of each reading."""
        scale, mu = np.where(recent, times, 1.0), np.where(recent, SOFT, np.inf)
        graph, noise, robust = gtsam.NonlinearFactorGraph(), self._drive.sensors.noise, self._options.robust
        for k in range(self._first, self._last):
            graph.add(step_factor(self._drive, k))
        fixed = None if self._calibrations else self._drive.sensors.fixed()
        for number in sorted(set(self._tile_of.values())):
            if number >= self._old:
                m = len(self._tiles[number].field)
                unit = gtsam.noiseModel.Unit.Create(m)
                graph.add(gtsam.PriorFactorVector(M(number), np.zeros(m), unit))
        for laid, sight in self._seen():
            at = np.searchsorted(self._rows, laid.rows)
            own = scale[at]
            if laid.number >= self._old and not self._values.atVector(M(laid.number)).any():
                likely = laid.likely_weights(self._sensors, own.max() * noise)
                self._values.update(M(laid.number), likely)
                sight = laid.sight(likely, self._sensors)
            W = sight.whitening(noise)
            for each in np.unique(own[own > 1]):
                W[own == each] = sight.whitening(each * noise)[own == each]
            r2 = sight.squared(W)
            for each in np.unique(mu[at]):
                some = mu[at] == each
                self._weights[at[some]] = WEIGHTS[robust.loss](r2[some], robust.largest, each)
            weights = self._weights[at]
            chosen = np.flatnonzero(weights > NOTHING)
            if not len(chosen):
                continue
            readings = self._drive.readings[laid.rows[chosen]]
            batch = TileBatch(laid.number, laid.anchor, laid.field, readings, fixed)
            variance = self._variance(laid)[chosen] * own[chosen, None] ** 2
            if last: doubt = laid.field.doubt(laid.place.x[chosen], variance, self._tiles[laid.number].taught)
            W = (W * np.sqrt(weights)[:, None, None])[chosen]
            for k in batch.key_poses:
                mine = batch.rows_of(k)
                graph.add(tile_factor(batch, k, W[mine]))
                factor = doubt_factor(batch, k, doubt[mine]) if last else None
                if factor is not None:
                    graph.add(factor)
        if self._prior is None:
            self._prior = Prior(self._known.marginal([*self._shared, *self._calibrations]))
        kept = self._kept()
        between = [X(k) for k in range(self._first, self._last + 1) if X(k) not in kept]
        sizes = {key: self._size(key) for key in [*between, *kept]}
        self._descent = descended(graph, self._prior, self._values, sizes, most)
        self._values = self._descent.values
        self.steps += self._descent.steps

    def _kept(self) -> list[int]:
        """Return the variables that outlive the section or began it, the last pose at the end."""
        numbers = sorted(set(self._tile_of.values()))
        weights = [M(number) for number in numbers]
        anchors = [X(self._tiles[number].anchor) for number in numbers]
        poses = dict.fromkeys([*self._shared, *anchors])
        last = X(self._last)
        own = [key for key in poses if gtsam.symbolChr(key) == ord("X") and key != last]
        return [*own, *weights, *self._calibrations, last]

    def _size(self, key: int) -> int:
        if gtsam.symbolChr(key) == ord("X"):
            return POSE
        if gtsam.symbolChr(key) == ord("T"):
            return 3
        return len(self._values.atVector(key))

    def _belief(self) -> Belief:
        assert self._descent is not None
        known = self._descent.last(1 + len(self._calibrations))
        covariance = np.roll(known.covariance, POSE, axis=(0, 1))
        return Belief(self._values.atPose3(X(self._last)), self._sensors, covariance)
