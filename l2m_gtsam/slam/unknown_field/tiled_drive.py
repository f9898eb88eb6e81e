"""A drive's readings partitioned into tiles of an unknown field, at an estimate of its poses."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import (
    Calibrations,
    ComplexityPenalty,
    KeyPoseReadings,
    M,
    TileBatch,
    effective_parameters_factor,
    tile_factor,
)
from l2m_gtsam.data import FieldSample, FloatArray, IntArray
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.map_prediction import MapPrediction, PlacedReadings, place_readings, predict
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.unknown_field.changed_visits import CLEAR, LIKELY, Seen, change_gain
from l2m_gtsam.slam.unknown_field.linear_field import AXES, LinearField
from l2m_gtsam.slam.unknown_field.sensor_noise import SlowErrors
from l2m_gtsam.slam.unknown_field.tiles import (
    Anchoring,
    FieldPrior,
    WaveTile,
    anchor_tiles,
    level_axes,
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


class FieldWithWeights:
    """A field with known weights, as a map in the frame of its anchor."""

    def __init__(self, tile: LinearField, weights: FloatArray) -> None:
        self._tile, self._weights = tile, weights

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        return self._tile.field_and_gradient(points, self._weights)

    def query(self, points: FloatArray) -> FieldSample:
        """Return the same with the variance of what the weights do not hold."""
        field, gradient = self.field_and_gradient(points)
        inside = np.ones(len(points), bool)
        return FieldSample(field, gradient, self._tile.unresolved(points), inside)


@dataclass(frozen=True)
class TiledDrive:
    """All tiles of a drive.

    Attributes
    ----------
    anchoring
        The tile of each key pose.
    tiles
        Tiles with readings.
    """

    anchoring: Anchoring
    tiles: tuple[OccupiedTile, ...]

    @classmethod
    def partition(
        cls,
        motions: RelativeMotions,
        poses: list[gtsam.Pose3],
        sensors: KnownSensors,
        prior: FieldPrior,
    ) -> "TiledDrive":
        """Return the tiles of a drive at an estimate of its motions, key poses and sensors."""
        R = np.stack([pose.rotation().matrix() for pose in poses])
        p = np.stack([pose.translation() for pose in poses])
        axes = level_axes(R)
        anchoring = anchor_tiles(R, p, prior.options.core)
        visits = RevisitedTiles(motions, poses, sensors, prior, axes)
        anchoring = visits.renewed(anchoring)
        owner = anchoring.tile[motions.readings.key_pose]
        tiles = []
        for number, anchor in enumerate(anchoring.anchor.tolist()):
            rows = np.flatnonzero(owner == number)
            if len(rows):
                where = relative_place(motions.readings[rows], poses, anchor, sensors)
                field = WaveTile.about(prior, R[anchor].T @ axes[anchor], where.x)
                tiles.append(OccupiedTile(number, anchor, rows, field, where))
        return cls(anchoring, tuple(tiles))

    def moved(
        self, motions: RelativeMotions, poses: list[gtsam.Pose3], sensors: KnownSensors
    ) -> "TiledDrive":
        """Return the same tiles with their readings at another estimate."""
        own = motions.readings
        tiles = (
            replace(tile, placed=relative_place(own[tile.rows], poses, tile.anchor, sensors))
            for tile in self.tiles
        )
        return TiledDrive(self.anchoring, tuple(tiles))

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
        return MapPrediction.joined(parts, [tile.rows for tile in tiles])

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

    def graph(
        self,
        motions: RelativeMotions,
        penalties: tuple[ComplexityPenalty, ...],
        whitening: FloatArray,
        by_lidar: FloatArray,
        chosen: IntArray,
        fixed: Calibrations | None,
        slow: SlowErrors | None = None,
    ) -> gtsam.NonlinearFactorGraph:
        """Return the factors of readings, and the prior of the tiles' weights.

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
        graph = gtsam.NonlinearFactorGraph()
        for tile, penalty in zip(self.tiles, penalties, strict=True):
            rows = np.intersect1d(tile.rows, chosen)
            unit = gtsam.noiseModel.Unit.Create(len(tile.field))
            graph.add(gtsam.PriorFactorVector(M(tile.number), np.zeros(len(tile.field)), unit))
            if len(rows):
                readings = motions.readings[rows]
                batch = TileBatch(tile.number, tile.anchor, tile.field, readings, fixed)
                for k in batch.key_poses:
                    own = rows[batch.rows_of(k)]
                    lasting, left = (None, None) if slow is None else slow.of(k, own)
                    white = motions.whitening(own, whitening[own], by_lidar[own], left)
                    step = motions.step_error(own, by_lidar[own])
                    graph.add(tile_factor(batch, k, white, step, lasting))
                    factor = effective_parameters_factor(batch, k, penalty[batch.rows_of(k)])
                    if factor is not None:
                        graph.add(factor)
        if slow is not None:
            graph.push_back(slow.graph())
        return graph


def relative_place(
    readings: KeyPoseReadings, poses: list[gtsam.Pose3], anchor: int, sensors: KnownSensors
) -> PlacedReadings:
    """Return readings at the poses of their key poses in the frame of an anchor."""
    origin = poses[anchor]
    own = {int(k): origin.between(poses[int(k)]) for k in np.unique(readings.key_pose)}
    return place_readings(readings, own, sensors)


KNOWN_M = 0.02  # standard deviation of a sensor's place, up to which tiles are judged
GONE = 15  # key poses elsewhere, after which one in a tile is of another visit


@dataclass(frozen=True)
class DividedTiles:
    """Tiles some of which changed, and between which key poses each did."""

    anchoring: Anchoring
    between: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class RevisitedTiles:
    """Tiles at an estimate of poses, and whether later visits find the field of earlier ones.

    Attributes
    ----------
    motions, poses, sensors, prior
        As for ``TiledDrive.partition``.
    axes
        Level axes of the key poses in the map, shape (K, 3, 3).
    """

    motions: RelativeMotions
    poses: list[gtsam.Pose3]
    sensors: KnownSensors
    prior: FieldPrior
    axes: FloatArray

    def renewed(self, anchoring: Anchoring) -> Anchoring:
        """Return the same with a tile of its own from each visit on that found another field.

        Steel that was moved is felt in other tiles, too: a visit between whose key poses and those
        of the visit before a tile changed clearly needs little evidence.
        """
        # Sensors at places that are not known find other fields from visit to visit, too.
        t = np.diagonal(self.sensors.covariance, axis1=-2, axis2=-1)[..., :3]
        if np.sqrt(t.max()) > KNOWN_M:
            return anchoring
        sure = self._divided(anchoring, ())
        return self._divided(anchoring, sure.between).anchoring if sure.between else anchoring

    def _divided(self, anchoring: Anchoring, known: tuple[tuple[int, int], ...]) -> "DividedTiles":
        anchors, tile = anchoring.anchor.tolist(), anchoring.tile.copy()
        between = []
        for number in range(len(anchoring)):
            own = np.flatnonzero(tile == number)
            visits = np.split(own, np.flatnonzero(np.diff(own) > GONE) + 1)
            first = 0
            for k in range(1, len(visits)):
                last, start = int(visits[k - 1][-1]), int(visits[k][0])
                alike = any(last < end and begin < start for begin, end in known)
                earlier = np.concatenate(visits[first:k])
                gain = self._gain(anchors[tile[earlier[0]]], earlier, visits[k])
                if gain > (LIKELY if alike else CLEAR):
                    later, first = np.concatenate(visits[k:]), k
                    tile[later] = len(anchors)
                    anchors.append(start)
                    between.append((last, start))
        return DividedTiles(Anchoring(np.array(anchors), tile), tuple(between))

    def _gain(self, anchor: int, earlier: IntArray, visit: IntArray) -> float:
        rows = [np.flatnonzero(np.isin(self._key_pose, each)) for each in (earlier, visit)]
        if not all(len(each) for each in rows):
            return 0.0
        every = np.concatenate(rows)
        where = relative_place(self.motions.readings[every], self.poses, anchor, self.sensors)
        R = self.poses[anchor].rotation().matrix()
        field = WaveTile.about(self.prior, R.T @ self.axes[anchor], where.x)
        noise = self.sensors.noise[self.motions.readings.sensor[every], None]
        variance = noise**2 + field.unresolved(where.x)
        b, count = where.field(self.sensors), len(rows[0])
        before, after = slice(0, count), slice(count, len(every))
        return change_gain(
            field,
            Seen(where.x[before], b[before], variance[before]),
            Seen(where.x[after], b[after], variance[after]),
        )

    @property
    def _key_pose(self) -> IntArray:
        return np.asarray(self.motions.readings.key_pose)
