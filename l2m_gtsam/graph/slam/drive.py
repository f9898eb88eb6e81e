"""What a localisation rests on: odometry, readings on key poses, calibrations, a start."""

from dataclasses import dataclass, field

import gtsam
import numpy as np

from l2m_factors import Calibrations, CarriedReadings
from l2m_gtsam.data import FloatArray, IntArray, Readings, RigidTransform, Trajectory
from l2m_gtsam.graph.slam.links import Links
from l2m_gtsam.graph.slam.odometry import OdometrySteps


@dataclass(frozen=True)
class KnownSensors:
    """Calibrations of the S sensors of a drive.

    Attributes
    ----------
    names
        In the order that readings count sensors.
    t, distortion, offset
        Position in metres (S, 3), C row by row and H in uT (S, 12), clock offset in seconds (S,).
    noise
        Standard deviation of each sensor's noise in uT, shape (S,).
    covariance
        Of (t, C row by row, H) in m and uT, shape (S, 15, 15).
    """

    names: tuple[str, ...]
    t: FloatArray
    distortion: FloatArray
    offset: FloatArray
    noise: FloatArray
    covariance: FloatArray

    def fixed(self) -> Calibrations:
        """Return them as constants of factors."""
        return Calibrations(self.t, self.distortion, self.offset)


@dataclass(frozen=True)
class StartPose:
    """Where a drive begins in the map.

    Attributes
    ----------
    T_map_lidar
        Pose.
    covariance
        Of a right perturbation, rotation (rad) before translation (m), shape (6, 6).
    """

    T_map_lidar: RigidTransform
    covariance: FloatArray


@dataclass(frozen=True)
class Drive:
    """A drive to be localised.

    Attributes
    ----------
    stamp_ns
        When the K key poses were, shape (K,).
    steps
        What odometry says between them.
    readings
        On them, in order of key poses, N in number.
    start
        Of the first.
    sensors
        That read.
    links
        What scans say of key poses.
    """

    stamp_ns: IntArray
    steps: OdometrySteps
    readings: CarriedReadings
    start: StartPose
    sensors: KnownSensors
    links: Links = field(default_factory=Links.none)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def dead_reckoning(self) -> list[gtsam.Pose3]:
        """Return the key poses that odometry alone leads to from the start."""
        poses = [as_pose(self.start.T_map_lidar)]
        for step in range(len(self.steps)):
            poses.append(poses[-1].compose(self.step(step)))
        return poses

    def step(self, number: int) -> gtsam.Pose3:
        """Return the way from a key pose to the next."""
        return gtsam.Pose3(gtsam.Rot3(self.steps.R[number]), self.steps.p[number])


def as_pose(transform: RigidTransform) -> gtsam.Pose3:
    """Return a transform as GTSAM's pose."""
    return gtsam.Pose3(gtsam.Rot3(transform.R), transform.t)


def carried(
    readings: Readings, trajectory: Trajectory, rows: IntArray, most: int
) -> CarriedReadings:
    """Hang readings on the key pose before each, and keep not too many.

    Parameters
    ----------
    readings
        With poses of odometry.
    trajectory
        Odometry.
    rows
        Which of its poses are key poses, shape (K,).
    most
        Readings of a sensor on a key pose.
    """
    key = np.searchsorted(trajectory.stamp_ns[rows], readings.stamp_ns, side="right") - 1
    key = np.clip(key, 0, len(rows) - 1)
    kept = spread(np.column_stack([key, readings.sensor]), most)
    readings, key = readings[kept], key[kept]
    R_back, p = trajectory.R[rows[key]].transpose(0, 2, 1), trajectory.p[rows[key]]
    return CarriedReadings(
        key_pose=key,
        sensor=readings.sensor,
        R_key_lidar=R_back @ readings.R_map_lidar,
        p_key_lidar=np.einsum("nij,nj->ni", R_back, readings.p_map_lidar - p),
        field=readings.field,
    )


def spread(groups: IntArray, most: int) -> IntArray:
    """Return at most so many rows of each group, spread over it, ordered by group.

    ``groups`` has a row of labels for each, shape (N, L); members of a group come in order.
    """
    order = np.lexsort(groups.T[::-1])
    ends = np.flatnonzero(np.diff(groups[order], axis=0).any(axis=1)) + 1
    return np.concatenate([_some(part, most) for part in np.split(order, ends)])


def _some(rows: IntArray, most: int) -> IntArray:
    chosen = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
    return np.asarray(rows[chosen])
