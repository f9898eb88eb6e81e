"""What is read from a recording, and how."""

from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.errors import BagError
from l2m_gtsam.options import Options
from l2m_gtsam.storage.regressor_options import RegressorName, RegressorTopic
from l2m_gtsam.storage.units import Unit


class Stamps(StrEnum):
    """Which time of a message counts."""

    HEADER = "header"
    RECORD = "record"


class TfChain(Options):
    """Two frames between which poses are composed."""

    frame: str
    """Reference frame, for example `map`."""
    child_frame: str
    """Tracked frame, for example `base_link`."""
    max_gap_s: float = Field(default=1.0, gt=0)
    """No pose is made where two transforms of a link in the chain are further apart."""


class FixedTransform(Options):
    """A rigid transform as numbers."""

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres."""
    quaternion_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Rotation; of any length but zero."""

    def rigid(self) -> RigidTransform:
        """Return the transform as matrix and vector.

        Raises
        ------
        BagError
            The quaternion is all zero.
        """
        if not any(self.quaternion_xyzw):
            msg = "bag.tracked_to_lidar: the quaternion is all zero, it must be a rotation"
            raise BagError(msg)
        R = Rotation.from_quat(self.quaternion_xyzw).as_matrix()
        return RigidTransform(R, np.array(self.translation))


class BagOptions(Options):
    """What is read from a recording, and how."""

    fields: Annotated[tuple[str, ...], Field(min_length=1)] = ("*",)
    """Topics of type sensor_msgs/MagneticField, names or globs; the leading slash does not
    matter."""
    split_by_frame: bool = False
    """Whether one topic carries several sensors, told apart by `header.frame_id`; sensors are
    then named after their frame instead of their topic."""
    poses: str | None = None
    """Topic of the poses: Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped;
    if not given, the only such topic of the bag, Odometry first."""
    tf: TfChain | None = None
    """Compose the poses from /tf and /tf_static instead."""
    tracked_to_lidar: FixedTransform = FixedTransform()
    """T_tracked_lidar: the lidar in the frame that the poses track."""
    frame: str | None = None
    """Name to give the frame that the poses are in, where the bag calls the map's otherwise."""
    stamps: Stamps = Stamps.HEADER
    """`header`, or `record` for the time at which the bag received a message."""
    units: Unit = Unit.AUTO
    """Unit of the readings: `auto` takes tesla, as ROS prescribes, and refuses a strength that
    does not fit; or `tesla`, `millitesla`, `microtesla`, `nanotesla`, `gauss`, `milligauss`."""

    regressors: dict[RegressorName, RegressorTopic] = Field(default_factory=dict)
    """Numbers that `l2m calibrate` reads beside the readings, by names of your choice: motor
    currents, speeds, duty cycles. What follows them is told from the map's field."""

    @model_validator(mode="after")
    def _one_source_of_poses(self) -> "BagOptions":
        if self.poses is not None and self.tf is not None:
            raise ValueError("give `poses` or `tf`, not both")
        return self
