"""A drive's readings partitioned into tiles of an unknown field, at an estimate of its poses."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import (
    Calibrations,
    ComplexityPenalty,
    KeyPoseReadings,
    M,
    ReadingErrors,
    TileBlocks,
    WeightedField,
)
from l2m_gtsam.calibration.factor_graph import unit_priors
from l2m_gtsam.data import FieldSample, FloatArray, IntArray, chosen_rows, joined_rows
from l2m_gtsam.slam.drive import KnownSensors, stacked
from l2m_gtsam.slam.map_prediction import MapPrediction, PlacedReadings, predict
from l2m_gtsam.slam.pose_graph import successive
from l2m_gtsam.slam.relative_motion import RelativeMotions, by_key_pose
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.unknown_field.linear_field import AXES, LinearField
from l2m_gtsam.slam.unknown_field.revisited_tiles import RevisitedTiles
from l2m_gtsam.slam.unknown_field.sensor_noise import SlowErrors
from l2m_gtsam.slam.unknown_field.tiles import (
    Anchoring,
    FieldPrior,
    WaveTile,
    anchor_tiles,
    level_axes,
    relative_place,
)


@dataclass(frozen=True)
class OccupiedTile:
    """A tile and the readings in it.

    Attributes
    ----------
    number, anchor
        Its own number, and that of the key pose that anchors it.
    rows
        Rows of its readings in the drive, shape (n,).
    field
        Basis of its m weights.
    placed
        The readings in the anchor's frame.
    """

    number: int
    anchor: int
    rows: IntArray
    field: LinearField
    placed: PlacedReadings

    def robust_weights(self, sensors: KnownSensors, noise: FloatArray) -> FloatArray:
        """Return a robust estimate of the weights from the readings at their current places."""
        own = noise[self.placed.readings.sensor, None] ** 2
        variance = own + self.field.unresolved(self.placed.x)
        b = self.placed.field(sensors)
        return self.field.robust_weights(self.placed.x, b, variance)

    def penalty(self, rows: IntArray, noise: FloatArray) -> ComplexityPenalty:
        """Return the penalty of the parameters that some of its readings determine."""
        own = np.searchsorted(self.rows, rows)
        x = self.placed.x[own]
        variance = noise[self.placed.readings.sensor[own], None] ** 2 + self.field.unresolved(x)
        return self.field.penalty(x, variance)

    def prediction(self, weights: FloatArray, sensors: KnownSensors) -> MapPrediction:
        """Return the tile's prediction of its readings, in the anchor's frame."""
        return predict(FieldWithWeights(self.field, weights), self.placed, sensors)


class FieldWithWeights(WeightedField):
    """A field with known weights, as a map in the frame of its anchor."""

    def __init__(self, tile: LinearField, weights: FloatArray) -> None:
        super().__init__(tile, weights)
        self._unresolved = tile.unresolved

    def query(self, points: FloatArray) -> FieldSample:
        """Return the field with the variance of what the weights do not hold."""
        field, gradient = self.field_and_gradient(points)
        inside = np.ones(len(points), bool)
        return FieldSample(field, gradient, self._unresolved(points), inside)


def anchored(poses: list[gtsam.Pose3], prior: FieldPrior) -> tuple[Anchoring, FloatArray]:
    """Return the tiles of K key poses, and their level axes in the map, shape (K, 3, 3)."""
    R, p = stacked(poses)
    return anchor_tiles(R, p, prior.options.core), level_axes(R)


def occupied_tiles(
    anchoring: Anchoring,
    readings: KeyPoseReadings,
    poses: list[gtsam.Pose3],
    sensors: KnownSensors,
    prior: FieldPrior,
) -> Iterator[OccupiedTile]:
    """Yield the tiles that have readings, at an estimate of a drive's key poses."""
    owner = anchoring.tile[readings.key_pose]
    for number, anchor in enumerate(anchoring.anchor.tolist()):
        rows = np.flatnonzero(owner == number)
        if len(rows):
            where = relative_place(readings[rows], poses, anchor, sensors)
            axes = level_axes(poses[anchor].rotation().matrix()[None])[0]
            up = poses[anchor].rotation().matrix().T @ axes
            yield OccupiedTile(number, anchor, rows, WaveTile.about(prior, up, where.x), where)


@dataclass(frozen=True)
class TiledDrive:
    """All tiles of a drive.

    Attributes
    ----------
    anchoring
        The tile of each key pose.
    tiles
        Tiles with readings.
    brought
        What steel that was moved on the drive adds to its N readings where their tiles are older,
        uT, in the sensors' frames, shape (N, 3).
    """

    anchoring: Anchoring
    tiles: tuple[OccupiedTile, ...]
    brought: FloatArray

    @classmethod
    def lasting(
        cls,
        motions: RelativeMotions,
        poses: list[gtsam.Pose3],
        sensors: KnownSensors,
        prior: FieldPrior,
    ) -> "TiledDrive":
        """Return tiles whose fields last, at an estimate of a drive's motions and key poses."""
        anchoring, _ = anchored(poses, prior)
        tiles = occupied_tiles(anchoring, motions.readings, poses, sensors, prior)
        return cls(anchoring, tuple(tiles), np.zeros_like(motions.readings.field))

    @classmethod
    def renewed(
        cls,
        motions: RelativeMotions,
        poses: list[gtsam.Pose3],
        sensors: KnownSensors,
        prior: FieldPrior,
    ) -> "TiledDrive":
        """Return tiles that end where visits find another field; arguments as of ``lasting``."""
        anchoring, axes = anchored(poses, prior)
        renewed = RevisitedTiles(motions, poses, sensors, prior, axes).renewed(anchoring)
        own = motions.without(renewed.brought).readings
        tiles = occupied_tiles(renewed.anchoring, own, poses, sensors, prior)
        return cls(renewed.anchoring, tuple(tiles), renewed.brought)

    def moved(
        self, motions: RelativeMotions, poses: list[gtsam.Pose3], sensors: KnownSensors
    ) -> "TiledDrive":
        """Return the same tiles with their readings at another estimate."""
        own = motions.without(self.brought).readings
        tiles = (
            replace(tile, placed=relative_place(own[tile.rows], poses, tile.anchor, sensors))
            for tile in self.tiles
        )
        return replace(self, tiles=tuple(tiles))

    def weights(self, sensors: KnownSensors, noise: FloatArray) -> gtsam.Values:
        """Return robust estimates of the weights of all tiles."""
        values = gtsam.Values()
        for tile in self.tiles:
            values.insert(M(tile.number), tile.robust_weights(sensors, noise))
        return values

    def prediction(self, values: gtsam.Values, sensors: KnownSensors) -> MapPrediction:
        """Return the tiles' predictions of all N readings, each in the frame of its anchor."""
        tiles = self.tiles
        parts = [tile.prediction(values.atVector(M(tile.number)), sensors) for tile in tiles]
        order = np.argsort(np.concatenate([tile.rows for tile in tiles]))
        return chosen_rows(joined_rows(parts), order)

    def away_from_steel(self, trust: FloatArray) -> FloatArray:
        """Return the weights of all N readings, 0 where waves do not hold the field, shape (N,).

        Parameters
        ----------
        trust
            Weight of each by itself, shape (N,).
        """
        counted = trust.copy()
        for tile in self.tiles:
            counted[tile.rows] = tile.field.away_from_steel(tile.placed.x, trust[tile.rows])
        return counted

    def penalties(
        self, noise: FloatArray, weights: FloatArray, squared: FloatArray
    ) -> tuple[ComplexityPenalty, ...]:
        """Return each tile's penalty by the readings that count, with the noise that they show.

        Parameters
        ----------
        noise
            Standard deviation of each sensor's noise in uT, shape (S,).
        weights
            Robust weights of all N readings, shape (N,).
        squared
            Squared lengths of their residuals, whitened by noise and unresolved waves, shape (N,).
        """
        chosen = np.flatnonzero(weights > REJECTED_WEIGHT)
        whole = [tile.penalty(np.intersect1d(tile.rows, chosen), noise) for tile in self.tiles]
        freedom = AXES * weights.sum() - sum(each.parameters for each in whole)
        noise_share = weights @ squared / freedom if freedom > 0 else 1.0
        # A share above 1 is due to poses that have not converged, not to noise.
        return tuple(each.scaled(min(noise_share, 1.0)) for each in whole)

    def graphs(
        self,
        motions: RelativeMotions,
        penalties: tuple[ComplexityPenalty, ...],
        whitening: FloatArray,
        by_lidar: FloatArray,
        chosen: IntArray,
        fixed: Calibrations | None,
        slow: SlowErrors | None = None,
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.NonlinearFactorGraph]:
        """Return the factors of readings with the prior of the tiles' weights, and the penalties'.

        Parameters
        ----------
        motions
            Relative motions when the drive was partitioned.
        penalties
            Penalty of each tile.
        whitening
            Of the residuals of all N readings, without odometry's errors, 1/uT, (N, 3, 3).
        by_lidar
            Their derivatives by a right perturbation of the lidar's pose, shape (N, 3, 6).
        chosen
            Rows of the readings that count.
        fixed
            Calibrations where they are constants; None where they are variables.
        slow
            Slow errors of the readings, which are variables then.
        """
        graph, doubts = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        motions = motions.without(self.brought)
        for tile, penalty in zip(self.tiles, penalties, strict=True):
            rows = np.intersect1d(tile.rows, chosen)
            graph.push_back(unit_priors({M(tile.number): len(tile.field)}))
            if len(rows):
                readings, W = motions.readings[rows], np.empty((len(rows), 3, 3))
                errors = dict[int, ReadingErrors]()
                for at in by_key_pose(readings.key_pose):
                    k, own = int(readings.key_pose[at[0]]), rows[at]
                    lasting, left = (None, None) if slow is None else slow.of(k, own)
                    white = motions.whitening(own, whitening[own], by_lidar[own], left)
                    step, W[at] = motions.step_error(own, by_lidar[own]), white.own
                    errors[k] = ReadingErrors(white.common, step, lasting)
                blocks = TileBlocks(tile.number, tile.anchor, tile.field, readings, W, fixed)
                for together in successive(blocks.key_poses):
                    own_errors = [errors[k] for k in together]
                    graph.add(blocks.residual_with_errors(together, own_errors).factor())
                    doubt = blocks.penalty(together, penalty)
                    if doubt is not None:
                        doubts.add(doubt.factor())
        if slow is not None:
            graph.push_back(slow.graph())
        return graph, doubts
