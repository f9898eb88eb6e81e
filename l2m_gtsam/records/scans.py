"""What a LiDAR saw in one turn, and what registering it says of poses: frozen records."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.options import Options


class ScanOptions(Options):
    """What is taken of a scan."""

    min_range: float = Field(default=0.5, ge=0)
    """Nearer points are dropped, metres from the lidar: they are the vehicle itself."""
    max_range: float = Field(default=30.0, gt=0, le=1000)
    """Further points are dropped, metres from the lidar."""

    @model_validator(mode="after")
    def _leave_room(self) -> Self:
        if self.min_range >= self.max_range:
            raise ValueError("`min_range` must be less than `max_range`")
        return self


@dataclass(frozen=True)
class Scan:
    """The points of one turn of a LiDAR.

    Attributes
    ----------
    stamp_ns
        Time in nanoseconds.
    points
        In metres, shape (N, 3), finite. Without ``time_s`` all are in the lidar frame at the stamp;
        with it, each is in the lidar frame at its own time.
    time_s
        When each point was measured in seconds after the stamp, shape (N,); None for a snapshot.
    """

    stamp_ns: int
    points: FloatArray
    time_s: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class PoseFix:
    """Where a lidar was in a map, by one scan alone.

    Attributes
    ----------
    stamp_ns
        Time of the scan in nanoseconds.
    T_map_lidar
        Pose.
    covariance
        Of its error, a right perturbation as in ``Trajectory``: rotation (rad) before translation
        (m) in the axes of the lidar, shape (6, 6). Large along what the scan does not show.
    """

    stamp_ns: int
    T_map_lidar: RigidTransform
    covariance: FloatArray


@dataclass(frozen=True)
class LoopClosure:
    """Where a lidar was, seen from where it had been before.

    Attributes
    ----------
    from_ns, to_ns
        Times of both scans in nanoseconds, the earlier one first.
    T_from_to
        The later pose in the frame of the earlier.
    covariance
        Of its error, a right perturbation as in ``PoseFix``, shape (6, 6).
    """

    from_ns: int
    to_ns: int
    T_from_to: RigidTransform
    covariance: FloatArray


@dataclass(frozen=True)
class ScanEvidence:
    """What the scans of a drive say of its poses, beside odometry.

    Attributes
    ----------
    fixes
        Where single scans were taken in the map, in order of time. Their errors count as
        independent.
    loops
        Where the vehicle came again, in order of the later time.
    """

    fixes: tuple[PoseFix, ...] = ()
    loops: tuple[LoopClosure, ...] = ()

    def __len__(self) -> int:
        return len(self.fixes) + len(self.loops)


def taken_at_once(scan: Scan, twist: FloatArray) -> FloatArray:
    """Return the points of a scan as they were at its stamp, shape (N, 3), metres.

    Parameters
    ----------
    scan
        Measured while the lidar moved, if its points have times.
    twist
        Angular velocity in rad/s and velocity in m/s in the lidar frame, shape (6,), constant over
        the scan.
    """
    if scan.time_s is None or not np.any(twist):
        return scan.points
    turned = Rotation.from_rotvec(scan.time_s[:, None] * twist[:3]).apply(scan.points)
    return np.asarray(turned + scan.time_s[:, None] * twist[3:])
