"""What is remembered of a drive through an unknown field: one dense Gaussian over its variables.

What a section estimates is carried over to all that is remembered by one conditioning, in 0.19 s
for 1,500 components. With all of these in its graph GTSAM took 1.2 to 1.5 s for a section.
"""

from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import block_diag

from l2m_factors import X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import KnownSensors, StartPose, as_pose, stacked
from l2m_gtsam.slam.joint_gaussian import JointGaussian, of_key_pose
from l2m_gtsam.slam.map_prediction import sensors_in
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.pose_graph import EXACT
from l2m_gtsam.slam.unknown_field.tiles import WaveTile, horizontal_distance, level_axes

CALIBRATION = (ord("T"), ord("D"))


@dataclass(frozen=True)
class RememberedTile:
    """A tile of the field in the memory.

    Attributes
    ----------
    number, anchor
        Its own number, and that of the key pose that anchors it.
    field
        Basis of its m weights.
    past_information
        Information about the weights by readings of marginalised poses, shape (m, m).
    returns
        How often the vehicle has come back to it.
    """

    number: int
    anchor: int
    field: WaveTile
    past_information: FloatArray
    returns: int = 0

    @classmethod
    def new(cls, number: int, anchor: int, field: WaveTile) -> "RememberedTile":
        """Return a tile without readings."""
        return cls(number, anchor, field, np.zeros((len(field), len(field))))


@dataclass(frozen=True)
class FieldMemory:
    """The memory of a drive.

    Attributes
    ----------
    known
        Joint Gaussian of the last key pose, the calibrations that are variables, and the tiles'
        anchors and weights.
    tiles
        B tiles by number.
    """

    known: JointGaussian
    tiles: tuple[RememberedTile, ...] = field(default=())

    @classmethod
    def at_start(cls, start: StartPose, free: KnownSensors | None = None) -> "FieldMemory":
        """Return the memory before a drive; ``free`` has the calibrations that are variables."""
        known = start.covariance
        if free is not None:
            known = block_diag(known, *free.covariance)
            # A calibration may state a parameter as exact.
            known += np.diag(np.maximum(EXACT**2 - np.diag(known), 0.0))
        return cls(of_key_pose(0, as_pose(start.T_map_lidar), free, known))

    @property
    def calibrations(self) -> list[int]:
        """Keys of the calibrations that are variables, position and distortion by turns."""
        return [key for key in self.known.sizes if gtsam.symbolChr(key) in CALIBRATION]

    def tile_at(self, number: int, core: float) -> int:
        """Return the number of the tile of a key pose; the next number if it is in none."""
        anchors = [self.known.values.atPose3(X(tile.anchor)) for tile in self.tiles]
        return tile_of(self.known.values.atPose3(X(number)), anchors, core)

    def belief(self, number: int, sensors: KnownSensors) -> Belief:
        """Return what is known of a key pose, and of sensors as far as they are variables."""
        known = self.known.marginal([X(number), *self.calibrations])
        own = sensors_in(known.values, sensors)
        return Belief(known.values.atPose3(X(number)), own, known.covariance)


def tile_of(pose: gtsam.Pose3, anchors: list[gtsam.Pose3], core: float) -> int:
    """Return the number of the nearest tile; the next number where its core has not the pose.

    ``core`` is the side of that, metres.
    """
    if not anchors:
        return 0
    R, places = stacked(anchors)
    distance = horizontal_distance(pose.translation() - places, level_axes(R))
    nearest = int(distance.argmin())
    return nearest if distance[nearest] <= core / 2 else len(anchors)
