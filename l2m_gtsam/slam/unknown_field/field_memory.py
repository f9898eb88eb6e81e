"""What is remembered of a drive on line: one Gaussian of the field and what it is fixed to."""

from dataclasses import dataclass, field

import gtsam
import numpy as np

from l2m_factors import X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import Drive, as_pose
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.unknown_field.joint_gaussian import JointGaussian
from l2m_gtsam.slam.unknown_field.tiles import WaveTile, level_axes, tile_about


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
        Of the last key pose, the tiles' anchors and weights.
    tiles
        By number.
    """

    known: JointGaussian
    tiles: tuple[ExploredTile, ...] = field(default=())

    @classmethod
    def at_start(cls, drive: Drive) -> "FieldMemory":
        """Return what is known before a drive."""
        values = gtsam.Values()
        values.insert(X(0), as_pose(drive.start.T_map_lidar))
        return cls(JointGaussian(values, {X(0): POSE}, drive.start.covariance))


def tile_of(pose: gtsam.Pose3, anchors: list[gtsam.Pose3], core: float) -> int:
    """Return the number of the tile that a pose lies in; the next one if it lies in none."""
    if not anchors:
        return 0
    axes = level_axes(np.stack([anchor.rotation().matrix() for anchor in anchors]))
    places = np.stack([anchor.translation() for anchor in anchors])
    return tile_about(pose.translation(), axes, places, core)
