"""Tiles of an unknown field, each fixed to a key pose, and the prior of their waves."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import cho_solve
from scipy.spatial.transform import Rotation

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.learning import LearningOptions, learn, maximise
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.modes import left_out
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES
from l2m_gtsam.maps.harmonic.tiling import Resolution, resolution_of, surveyed_area
from l2m_gtsam.maps.training import TrainingSet, cubes_of, merged, training_set
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.map_prediction import PlacedReadings, place_readings
from l2m_gtsam.slam.options import MOST_WAVES, TileOptions
from l2m_gtsam.slam.unknown_field.linear_field import LinearField
from l2m_gtsam.slam.unknown_field.read_path import path_with_readings

# Widening of the waves' prior: steel is not spread evenly, and with the prior as learnt a stretch
# with more of it was estimated too low, by 0.1-0.4 m with sigmas of 0.04 m. The bias falls with the
# square of this factor; the loss is small, for readings are dense along the path.
WIDER = 10.0

ALONG_AXES = np.array([0.5, 0.5, 1.0])  # variance of waves, in that of their vertical part
# Times the median deviation from the median field. Passes of the robot, warehouse and corridor have
# no reading beyond; 0.3 m from a pallet they deviate by ten times as much.
EXTREME = 6.0
GONE = 15  # key poses elsewhere, after which one in a tile is of another visit


@dataclass(frozen=True)
class FieldPrior:
    """The prior of every tile of an unknown field.

    Attributes
    ----------
    hyperparameters
        Strength and depth of the sources.
    resolution
        Shortest waves that are kept.
    options
        Core, margin.
    """

    hyperparameters: Hyperparameters
    resolution: Resolution
    options: TileOptions


def coarser(prior: FieldPrior, modes: int) -> FieldPrior:
    """Return a prior whose tiles have so many waves at most."""
    return replace(prior, resolution=prior.resolution.within(modes, prior.options.edge))


def larger(prior: FieldPrior) -> FieldPrior:
    """Return the prior of the larger tiles of the last stage, with waves as short as before.

    Where these are too many for a tile, the shortest are left out.
    """
    options = prior.options.last
    kept = prior.resolution.within(MOST_WAVES, options.edge)
    return replace(prior, options=options, resolution=kept)


def field_prior(points: FloatArray, field: FloatArray, options: TileOptions) -> FieldPrior:
    """Learn the prior from readings at known places.

    Parameters
    ----------
    points, field
        Places in metres and the field there in uT, in one frame, shapes (N, 3).
    options
        Size of tiles, limit of waves, hyperparameters if they are known.

    Raises
    ------
    MapError
        There are too few readings.
    """
    defaults = HarmonicOptions()
    readings = merged(training_set(points, field), defaults.merge, defaults.independent)
    hyperparameters = options.hyperparameters
    if hyperparameters is None:
        hyperparameters = learnt_hyperparameters(readings, options.modes)
    density = float(readings.weight.sum()) / surveyed_area(readings.points)
    wanted = resolution_of(hyperparameters, density, defaults.mode_share)
    kept = wanted.within(options.modes, options.edge)
    return FieldPrior(hyperparameters, kept, options)


def learnt_hyperparameters(readings: TrainingSet, modes: int) -> Hyperparameters:
    """Return strength and depth of the sources, in windows of so many modes.

    One prior holds for the whole drive. A sensor that passes steel at arm's length reads tens of
    times what it reads elsewhere. Sources that make this likely are next to the sensors: the depth
    of the stronger side ends on its bound, and nearly all of the field is in waves that no tile
    holds. Such readings are left out then.
    """
    defaults, learning = HarmonicOptions(), LearningOptions(modes=modes)
    tiling, share = defaults.tiling, defaults.mode_share
    learnt = learn(readings, NO_SOURCES, tiling, share, learning, maximise)
    known, usual = learnt.hyperparameters, np.flatnonzero(is_usual(readings.field))
    stronger = "floor" if known.floor_scale >= known.ceiling_scale else "ceiling"
    if len(usual) < len(readings) and f"{stronger}_depth" in learnt.at_bound:
        learnt = learn(readings[usual], NO_SOURCES, tiling, share, learning, maximise)
    return learnt.hyperparameters


def is_usual(field: FloatArray) -> BoolArray:
    """Return which of N readings are not ``EXTREME``; ``field`` in uT, shape (N, 3)."""
    away = np.linalg.norm(field - np.median(field, axis=0), axis=1)
    return np.asarray(away <= EXTREME * np.median(away))


def drive_prior(drive: Drive, poses: list[gtsam.Pose3], options: TileOptions) -> FieldPrior:
    """Learn the prior of the field from the first metres of a drive, at poses by odometry.

    Path without readings does not count.
    """
    path = path_with_readings(drive)
    early = np.flatnonzero(path[drive.readings.key_pose] <= options.learn_over_m)
    readings = drive.readings[early]
    where = place_readings(readings, poses, drive.sensors)
    return field_prior(where.x, where.field(drive.sensors), options)


@dataclass(frozen=True)
class WaveTile(LinearField):
    """Uniform field, floor and ceiling waves of a level box about an anchor, in its frame.

    ``prior`` is that from which both follow.
    """

    basis: WaveBasis
    prior: FieldPrior

    @classmethod
    def about(cls, prior: FieldPrior, R_anchor_level: FloatArray, points: FloatArray) -> "WaveTile":
        """Return the tile of some readings.

        Parameters
        ----------
        prior
            Of the field.
        R_anchor_level
            Axes of the box in the anchor's frame, shape (3, 3); the last points up.
        points
            Where the readings are in the anchor's frame in metres, shape (N, 3).
        """
        edge, z = prior.options.edge, points @ R_anchor_level[:, 2]
        low, high = float(z.min()), float(z.max())
        size, corner = np.array([edge, edge]), np.array([-edge / 2, -edge / 2, low])
        frame = TileFrame(R_anchor_level, R_anchor_level @ corner, size, high - low)
        basis = WaveBasis.over(frame, prior.resolution)
        learnt = np.exp(0.5 * basis.prior(prior.hyperparameters).log_variance)
        wider = np.append(np.ones(3), np.full(len(basis) - 3, WIDER))  # the uniform field is wide
        return cls(basis, wider * learnt, prior)

    def penalised(self, lower: FloatArray) -> FloatArray:
        """Return the covariance itself: the effective number of parameters (Mallows' C_p).

        With a prior that is wider than learnt, the volume would push poses away from the sources.
        """
        return np.asarray(cho_solve((lower, True), np.eye(len(lower))))

    @property
    def half_wave(self) -> float:
        """Half of the shortest wave of floor and ceiling, metres."""
        return np.pi / max(self.prior.resolution.floor, self.prior.resolution.ceiling)

    def unresolved(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis of unresolved waves, uT^2, shape (N, 3)."""
        return np.asarray(self._unresolved_of_sides(points).sum(axis=0)[:, None] * ALONG_AXES)

    def unresolved_together(self, points: FloatArray) -> FloatArray:
        """Return it times the number of points within half of the longest unresolved wave."""
        kept, edge = self.prior.resolution, self.prior.options.edge
        together = np.zeros(len(points))
        for side, variance in zip(
            (kept.floor, kept.ceiling), self._unresolved_of_sides(points), strict=True
        ):
            cell = cubes_of(points, np.pi / max(side, np.pi / edge))
            together += np.bincount(cell)[cell] * variance
        return np.asarray(together[:, None] * ALONG_AXES)

    def _unresolved_of_sides(self, points: FloatArray) -> FloatArray:
        """Return the variance of Bz by unresolved waves of floor and ceiling, uT^2, (2, N)."""
        h, kept = self.prior.hyperparameters, self.prior.resolution
        z = self.basis.frame.localise(points)[:, 2]
        over = self.basis.frame.height - z
        # The series diverges towards the sources: nearer than half their depth it is held constant.
        z, over = np.maximum(z, -0.5 * h.floor_depth), np.maximum(over, -0.5 * h.ceiling_depth)
        return np.stack(
            [
                left_out(h.floor_scale, h.floor_depth, kept.floor, z),
                left_out(h.ceiling_scale, h.ceiling_depth, kept.ceiling, over),
            ]
        )


@dataclass(frozen=True)
class Anchoring:
    """The tile of each key pose.

    Attributes
    ----------
    anchor
        Number of the key pose that anchors each of B tiles, shape (B,).
    tile
        Number of each key pose's tile, shape (K,).
    """

    anchor: IntArray
    tile: IntArray

    def __len__(self) -> int:
        return len(self.anchor)

    def returns(self, path: FloatArray, least_m: float) -> IntArray:
        """Return the key poses in tiles that are revisited after a path of ``least_m``.

        Parameters
        ----------
        path
            Path length from the start to each key pose in metres, shape (K,).
        least_m
            Path length away from a tile in metres.
        """
        left_at = np.full(len(self), np.nan)
        found, returned = [], False
        for k, (before, tile) in enumerate(zip([-1, *self.tile[:-1]], self.tile, strict=True)):
            if tile != before:
                left_at[before] = path[k - 1]
                returned = bool(path[k] - left_at[tile] >= least_m)
            if returned:
                found.append(k)
        return np.array(found, dtype=np.int64)


def visits_among(key_poses: IntArray) -> list[IntArray]:
    """Return the rows of each visit to a tile, of the key poses that are in it, ascending."""
    return np.split(np.arange(len(key_poses)), np.flatnonzero(np.diff(key_poses) > GONE) + 1)


def anchor_tiles(R: FloatArray, p: FloatArray, core: float) -> Anchoring:
    """Return tiles along a path: a new one wherever the vehicle is in the core of none.

    Parameters
    ----------
    R, p
        Key poses in the map, shapes (K, 3, 3) and (K, 3), metres.
    core
        Edge of a tile's core in metres.
    """
    anchors, axes = list[int](), level_axes(R)
    tile, nearest = np.zeros(len(p), dtype=np.int64), np.full(len(p), np.inf)
    outside = np.arange(len(p))
    while len(outside):
        anchor = int(outside[0])
        away = horizontal_distance(p[anchor:] - p[anchor], axes[anchor])
        rows = anchor + np.flatnonzero(away < nearest[anchor:])
        tile[rows], nearest[rows] = len(anchors), away[rows - anchor]
        anchors.append(anchor)
        outside = outside[nearest[outside] > core / 2]
    return Anchoring(np.array(anchors), tile)


def horizontal_distance(away: FloatArray, axes: FloatArray) -> FloatArray:
    """Return the larger of both horizontal components of vectors, shape (N,).

    Parameters
    ----------
    away
        In the map in metres, shape (N, 3).
    axes
        Level axes in the map, of all or of each, shape (3, 3) or (N, 3, 3).
    """
    level = np.einsum("...ji,...j->...i", axes, away)
    return np.asarray(np.abs(level[:, :2]).max(axis=1))


def level_axes(R: FloatArray) -> FloatArray:
    """Return level axes in the map with the vehicle's heading, shape (K, 3, 3)."""
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.asarray(Rotation.from_euler("z", yaw[:, None]).as_matrix())


def relative_place(
    readings: KeyPoseReadings, poses: list[gtsam.Pose3], anchor: int, sensors: KnownSensors
) -> PlacedReadings:
    """Return readings at the poses of their key poses in the frame of an anchor."""
    origin = poses[anchor]
    own = {int(k): origin.between(poses[int(k)]) for k in np.unique(readings.key_pose)}
    return place_readings(readings, own, sensors)
