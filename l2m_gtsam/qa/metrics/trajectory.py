"""A localised drive as arrays, from its record."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import to_ros
from l2m_gtsam.records.localisation_file import LocalisationRecord

HEADING = 5  # of x, y, z, and rotations about them


@dataclass(frozen=True)
class LocalisedTrajectory:
    """K key poses.

    Attributes
    ----------
    seconds, distance
        Since the first, in s and in m along the localised path, shape (K,).
    p, odometry
        DriveSolution places, and those of odometry alone, in the map in metres, shape (K, 3).
    apart, turned
        Distance of both in m and angle of both in degrees, shape (K,).
    covariance
        Of the places in m^2 along the axes of the map, shape (K, 3, 3); NaN where unknown.
    sigma, odometry_sigma
        Of localised poses and of odometry alone: along x, y, z of the map in m, and about them in
        degrees, shape (K, 6).
    """

    seconds: FloatArray
    distance: FloatArray
    p: FloatArray
    odometry: FloatArray
    apart: FloatArray
    turned: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    odometry_sigma: FloatArray

    @property
    def heading_sigma(self) -> FloatArray:
        """Of localised poses in degrees, shape (K,)."""
        return self.sigma[:, HEADING]

    @property
    def position_sigma(self) -> FloatArray:
        """The largest along an axis of the map in metres, shape (K,)."""
        return np.asarray(self.sigma[:, :3].max(axis=1))

    def place_at(self, second: float) -> tuple[float, float]:
        """Return where the lidar was then, x and y in the map in metres."""
        x, y = (float(np.interp(second, self.seconds, axis)) for axis in self.p[:, :2].T)
        return x, y


def localised_trajectory(record: LocalisationRecord) -> LocalisedTrajectory:
    """Return the key poses of a drive."""
    stamps = np.array([each.stamp_ns for each in record.poses])
    p, odometry = (np.array([each.p for each in part]) for part in (record.poses, record.odometry))
    R, alone = (
        Rotation.from_quat([each.quaternion_xyzw for each in part])
        for part in (record.poses, record.odometry)
    )
    covariance = to_ros(_covariances(record), R.as_matrix())
    degrees = np.repeat([1.0, np.rad2deg(1.0)], 3)
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    return LocalisedTrajectory(
        seconds=1e-9 * (stamps - stamps[0]),
        distance=np.append(0.0, np.cumsum(steps)),
        p=p,
        odometry=odometry,
        apart=np.linalg.norm(odometry - p, axis=1),
        turned=np.rad2deg((R.inv() * alone).magnitude()),
        covariance=covariance[:, :3, :3],
        sigma=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * degrees,
        odometry_sigma=np.array([each.sigma for each in record.odometry]),
    )


def _covariances(record: LocalisationRecord) -> FloatArray:
    """Return the covariances of right perturbations, shape (K, 6, 6)."""
    unknown = np.full((6, 6), np.nan)
    return np.stack(
        [unknown if each.covariance is None else np.array(each.covariance) for each in record.poses]
    )
