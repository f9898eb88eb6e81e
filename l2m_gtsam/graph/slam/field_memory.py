"""What is remembered of a drive on line: one Gaussian of the field and what it is fixed to."""

from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import block_diag

from l2m_factors import D, T, X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.graph.slam.belief import POSE, SENSOR
from l2m_gtsam.graph.slam.drive import Drive, as_pose
from l2m_gtsam.graph.slam.factors import calibration_values, root_information
from l2m_gtsam.graph.slam.joint_gaussian import JointGaussian
from l2m_gtsam.graph.slam.tiles import WaveTile, level_axes, tile_about

PLACE = SENSOR - 12  # components of t_lidar_mag


@dataclass(frozen=True)
class ExploredTile:
    """A tile of the field as it is remembered.

    Attributes
    ----------
    number, anchor
        Its own, and of the key pose that it is fixed to.
    field
        What its m weights mean.
    taught
        Information about them of readings that were let go, shape (m, m).
    """

    number: int
    anchor: int
    field: WaveTile
    taught: FloatArray

    @classmethod
    def new(cls, number: int, anchor: int, field: WaveTile) -> "ExploredTile":
        """Return a tile that nothing is known of."""
        return cls(number, anchor, field, np.zeros((len(field), len(field))))


@dataclass(frozen=True)
class FieldMemory:
    """What is remembered.

    Attributes
    ----------
    known
        Of the last key pose, calibrations that are variables, the tiles' anchors and weights.
    tiles
        By number.
    """

    known: JointGaussian
    tiles: tuple[ExploredTile, ...] = field(default=())

    @classmethod
    def at_start(cls, drive: Drive, *, free: bool) -> "FieldMemory":
        """Return what is known before a drive, with calibrations as variables or without."""
        values, sizes, blocks = gtsam.Values(), {X(0): POSE}, [drive.start.covariance]
        values.insert(X(0), as_pose(drive.start.T_map_lidar))
        if free:
            values.insert(calibration_values(drive.sensors))
            for i, covariance in enumerate(drive.sensors.covariance):
                sizes |= {T(i): PLACE, D(i): SENSOR - PLACE}
                W = root_information(covariance)
                blocks.append(np.asarray(np.linalg.inv(W.T @ W)))
        return cls(JointGaussian(values, sizes, block_diag(*blocks)))

    @property
    def calibrations(self) -> list[int]:
        """Keys of the calibrations that are variables."""
        return [key for key in self.known.sizes if gtsam.symbolChr(key) in b"TD"]


def tile_of(pose: gtsam.Pose3, anchors: list[gtsam.Pose3], core: float) -> int:
    """Return the number of the tile that a pose lies in; the next one if it lies in none."""
    if not anchors:
        return 0
    axes = level_axes(np.stack([anchor.rotation().matrix() for anchor in anchors]))
    places = np.stack([anchor.translation() for anchor in anchors])
    return tile_about(pose.translation(), axes, places, core)
