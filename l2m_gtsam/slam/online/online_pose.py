"""What is handed out of a key pose when it is made."""

from dataclasses import dataclass

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.slam.drive import KnownSensors, as_transform
from l2m_gtsam.slam.online.belief import Belief


@dataclass(frozen=True)
class OnlinePose:
    """What is known of a key pose when it is made.

    Attributes
    ----------
    stamp_ns
        Its time.
    T_map_lidar
        Pose of the lidar.
    covariance
        Of a right perturbation of it, rotation (rad) before translation (m), shape (6, 6).
    sensors
        Calibrations as they are known by then, with the covariances of then.
    """

    stamp_ns: int
    T_map_lidar: RigidTransform
    covariance: FloatArray
    sensors: KnownSensors

    @classmethod
    def of(cls, stamp_ns: int, belief: Belief) -> "OnlinePose":
        """Return a belief as it is handed out."""
        # A part of the belief's covariance would keep all of it for as long as the pose is kept.
        covariance = belief.pose_covariance.copy()
        return cls(stamp_ns, as_transform(belief.pose), covariance, belief.known_sensors)
