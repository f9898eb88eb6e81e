"""Poses: one, and a body's along its way."""

from dataclasses import dataclass

from l2m_gtsam.data.arrays import FloatArray, IntArray
from l2m_gtsam.data.tables import TimedTable


@dataclass(frozen=True)
class RigidTransform:
    """A rotation and a translation, ``p_a = R @ p_b + t``.

    Attributes
    ----------
    R
        Rotation matrix, shape (3, 3).
    t
        Translation in metres, shape (3,).
    """

    R: FloatArray
    t: FloatArray

    def inverse(self) -> "RigidTransform":
        """Return the transform from a to b."""
        return RigidTransform(self.R.T, -self.R.T @ self.t)


@dataclass(frozen=True)
class Trajectory(TimedTable):
    """Poses of one body in one reference frame, in order of time.

    Attributes
    ----------
    stamp_ns
        Times in nanoseconds, strictly increasing, shape (N,).
    R
        Rotations from body to reference, shape (N, 3, 3).
    p
        Positions of the body's origin in the reference frame in metres, shape (N, 3).
    frame
        Name of the reference frame ("map").
    child_frame
        Name of the body frame ("lidar").
    covariance
        Covariance of each pose's error, shape (N, 6, 6), or None where it is unknown. The error
        is a right perturbation in GTSAM's order, ``T_true = T @ Exp(error)``: a rotation in
        radians, then a translation in metres, both along the axes of the body.
    """

    stamp_ns: IntArray
    R: FloatArray
    p: FloatArray
    frame: str
    child_frame: str
    covariance: FloatArray | None = None

    def pose(self, row: int) -> RigidTransform:
        """Return one of the poses."""
        return RigidTransform(self.R[row], self.p[row])
