"""A pose of odometry as it comes, and several as a trajectory."""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.errors import InputError

ORTHOGONAL = 1e-3  # of R R^T: more is no rotation
EXACT = 1e-12  # of R R^T: less does not grow to anything


@dataclass(frozen=True)
class OdometryPose:
    """A pose of odometry.

    Attributes
    ----------
    stamp_ns
        Its time.
    T
        Pose of the lidar in the frame of odometry.
    covariance
        That odometry states of it, as of a ``Trajectory``, (6, 6); None for none.
    """

    stamp_ns: int
    T: RigidTransform
    covariance: FloatArray | None = None

    @property
    def is_rigid(self) -> bool:
        """Whether it is finite, with a rotation."""
        R, t = self.T.R, self.T.t
        if not (np.isfinite(R).all() and np.isfinite(t).all()):
            return False
        return bool(np.abs(R @ R.T - np.eye(3)).max() < ORTHOGONAL and np.linalg.det(R) > 0)

    @property
    def proper(self) -> "OdometryPose":
        """The same in arrays of its own, with the nearest rotation, and a finite covariance."""
        R = self.T.R.copy()
        if np.abs(R @ R.T - np.eye(3)).max() > EXACT:
            # What little a matrix of single precision lacks would grow from step to step.
            R = gtsam.Rot3.ClosestTo(R).matrix()
        covariance = self.covariance
        if covariance is not None:
            covariance = covariance.copy() if np.isfinite(covariance).all() else None
        return OdometryPose(self.stamp_ns, RigidTransform(R, self.T.t.copy()), covariance)

    def require_shapes(self) -> None:
        """Raise an InputError if it is of something else than arrays of the right shapes."""
        if not isinstance(self.T, RigidTransform):
            came = type(self.T).__name__
            raise InputError(f"a pose of odometry: T is a {came}; needed is a RigidTransform")
        wanted = {"T.R": (self.T.R, (3, 3)), "T.t": (self.T.t, (3,))}
        if self.covariance is not None:
            wanted["covariance"] = self.covariance, (6, 6)
        for name, (array, shape) in wanted.items():
            if not isinstance(array, np.ndarray) or array.shape != shape:
                came = getattr(array, "shape", type(array).__name__)
                raise InputError(f"a pose of odometry: {name} is {came}; needed: array of {shape}")


def trajectory_of(poses: list[OdometryPose]) -> Trajectory:
    """Return poses of odometry as a trajectory; with covariances if all of them state one."""
    covariance = [each.covariance for each in poses if each.covariance is not None]
    return Trajectory(
        np.array([each.stamp_ns for each in poses], dtype=np.int64),
        np.stack([each.T.R for each in poses]),
        np.stack([each.T.t for each in poses]),
        "odom",
        "lidar",
        np.stack(covariance) if len(covariance) == len(poses) else None,
    )


def pose_of(trajectory: Trajectory, row: int) -> OdometryPose:
    """Return a pose of a recorded odometry."""
    covariance = None if trajectory.covariance is None else trajectory.covariance[row]
    return OdometryPose(int(trajectory.stamp_ns[row]), trajectory.pose(row), covariance)
